"""What happens beside the learning: violations are counted, and their price is adapted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from agents.loop import CostPenalty, LagrangianSettings
from agents.results import TrainingPoint
from agents.sb3_vec_env import INFO_KEYWORDS, SB3VecEnv

# What to do with environments that are no loops.
OTHERS = 'agents.train is for environments with "cost" in their infos: train others by stable-baselines3 itself'
# The history has about this many points where every step of all environments is a rollout.
_MAX_POINTS = 200


class SafetyCallback(BaseCallback):
    """Counts violations of the true state and interventions in every training step, and logs their rates.

    It works with any stable-baselines3 algorithm, on `SB3VecEnv` and on single environments. TensorBoard gets
    `safety/violation_steps` (total) and means over the steps since the last log: `safety/violation_rate`,
    `safety/intervention_rate`, and with a shield `safety/mean_correction` (norm of applied minus proposed input) and
    `safety/guaranteed_rate` (steps after which the state is proved safe).

    A training step is counted once; behind action repeat `episode_violations` and `episode_interventions` count all.
    Totals begin anew where the model counts its steps anew (`learn` with `reset_num_timesteps`).

    Args:
        on_progress: Called with the number of steps taken since its last call.
        priced: The penalty of PPO-Lagrangian, whose value totals hold; None without one.

    Attributes:
        history: Totals after every rollout; where rollouts are single steps, after every 200th part of the training.
        violation_steps, interventions: As in `TrainingPoint`, so far.
    """

    def __init__(self, on_progress: Callable[[int], None] | None = None, priced: CostPenalty | None = None) -> None:
        super().__init__()
        self._on_progress, self._priced = on_progress, priced
        self.history: list[TrainingPoint] = []
        self.violation_steps = self.interventions = self._noted = 0

    def _on_training_start(self) -> None:
        self._interval = self.locals["total_timesteps"] // _MAX_POINTS
        if self.num_timesteps < self._noted:
            self.history, self.violation_steps, self.interventions = [], 0, 0
        self._noted = self.num_timesteps

    def _on_step(self) -> bool:
        batch = _counted(self)
        violations = np.asarray(batch["cost"]) > 0.0
        interventions = batch.get("shield_intervened", np.zeros(len(violations)))
        self.violation_steps += int(violations.sum())
        self.interventions += int(np.sum(interventions))
        rates = {"violation_rate": violations, "intervention_rate": interventions}
        rates |= {"mean_correction": batch.get("shield_correction"), "guaranteed_rate": batch.get("shield_guaranteed")}
        for name, values in rates.items():
            if values is not None:
                self.logger.record_mean(f"safety/{name}", float(np.mean(values)))
        self.logger.record("safety/violation_steps", self.violation_steps)
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps - self._noted >= self._interval:
            self._note()

    def _on_training_end(self) -> None:
        if self._noted < self.num_timesteps:
            self._note()

    def _note(self) -> None:
        returns = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        mean = float(np.mean(returns)) if returns else float("nan")
        multiplier = float("nan") if self._priced is None else self._priced.penalty
        point = TrainingPoint(self.num_timesteps, mean, self.violation_steps, self.interventions, multiplier)
        self.history.append(point)
        taken, self._noted = self.num_timesteps - self._noted, self.num_timesteps
        if self._on_progress is not None:
            self._on_progress(taken)


class DualAscentCallback(BaseCallback):
    """Raises the penalty of violations while the agent violates: the dual ascent of PPO-Lagrangian.

    The agent maximizes the mean of reward - multiplier * cost, the multiplier minimizes it over the numbers >= 0. After
    every rollout, with J the cost of an episode of full length at the rollout's mean cost per step, and d the limit,

        multiplier <- max(0, multiplier + learning_rate (J - d)).

    Rollouts that are shorter than an episode are taken together until they are as long. J does not wait for episodes to
    end, and an episode that a violation ends does not count as a cheap one.

    This is the constrained baseline of Ray et al. 2019 with a plain gradient step in place of Adam, and the PID
    controller of Stooke et al. 2020 with the integral term alone (docs/bibliography.md). The cost is part of
    the reward, so one value function estimates both, where theirs have one each. TensorBoard gets `safety/multiplier`.

    Args:
        settings: Limit and learning rate.
        priced: The penalty, which is set.
        episode_steps: See `LoopConfig.episode_steps`.
    """

    def __init__(self, settings: LagrangianSettings, priced: CostPenalty, episode_steps: int) -> None:
        super().__init__()
        self._settings, self._priced, self._episode_steps = settings, priced, episode_steps
        self._cost, self._steps = 0.0, 0

    def _on_step(self) -> bool:
        costs = _counted(self)["cost"]
        self._cost, self._steps = self._cost + float(np.sum(costs)), self._steps + len(costs)
        return True

    def _on_rollout_end(self) -> None:
        if self._steps >= self._episode_steps:
            excess = self._cost / self._steps * self._episode_steps - self._settings.cost_limit
            self._priced.penalty = max(0.0, self._priced.penalty + self._settings.learning_rate * excess)
            self._cost, self._steps = 0.0, 0
        self.logger.record("safety/multiplier", self._priced.penalty)


def _counted(callback: BaseCallback) -> dict[str, Any]:
    """Returns what is counted of the infos of the last step, an entry for each environment."""
    env: VecEnv = callback.training_env
    while isinstance(env, VecEnvWrapper):
        env = env.venv
    if isinstance(env, SB3VecEnv) and "cost" in env.batch_info:
        return env.batch_info
    infos = callback.locals["infos"]
    if not infos or not all("cost" in info for info in infos):
        raise ValueError(
            f'SafetyCallback counts "cost" of every info, which the infos of these environments have not; {OTHERS}'
        )
    known = {key: [info[key] for info in infos if key in info] for key in INFO_KEYWORDS}  # some may be without a shield
    return {key: values for key, values in known.items() if values}
