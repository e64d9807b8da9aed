"""Counts what happens during training, step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from agents.sb3_vec_env import SB3VecEnv


@dataclass(frozen=True)
class TrainingPoint:
    """Totals after one rollout.

    Attributes:
        steps: Environment steps so far.
        episode_return: Mean over the last finished episodes, shield penalties included (NaN before the first).
        violation_steps: Steps so far whose true state violated the safe box.
        interventions: Steps so far in which the shield intervened.
    """

    steps: int
    episode_return: float
    violation_steps: int
    interventions: int


class SafetyCallback(BaseCallback):
    """Counts violations of the true state and interventions in every training step, and logs their rates.

    The counts come from each step's info; `Monitor` alone would see the last step of each episode only. Works with any
    stable-baselines3 algorithm, on `SB3VecEnv` and on single environments. TensorBoard gets `safety/violation_rate`,
    `safety/intervention_rate` (per step since the last log) and `safety/violation_steps` (total).

    Args:
        on_progress: Called with the number of steps taken since its last call.
    """

    def __init__(self, on_progress: Callable[[int], None] | None = None) -> None:
        super().__init__()
        self.history: list[TrainingPoint] = []
        self._on_progress = on_progress
        self._violations = self._interventions = 0
        self._logged = (0, 0, 0)
        self._reported = 0

    @property
    def violation_steps(self) -> int:
        """Steps so far whose true state violated the safe box."""
        return self._violations

    @property
    def interventions(self) -> int:
        """Steps so far in which the shield intervened."""
        return self._interventions

    def _on_step(self) -> bool:
        batch = _batch_info(self.training_env)
        if batch is None:
            infos = self.locals["infos"]
            batch = {key: [info[key] for info in infos] for key in ("cost", "shield_intervened") if key in infos[0]}
        self._violations += int((np.asarray(batch["cost"]) > 0.0).sum())
        self._interventions += int(np.sum(batch.get("shield_intervened", 0)))
        return True

    def _on_rollout_end(self) -> None:
        steps, violations, interventions = self._logged
        taken = max(self.num_timesteps - steps, 1)
        self.logger.record("safety/violation_rate", (self._violations - violations) / taken)
        self.logger.record("safety/intervention_rate", (self._interventions - interventions) / taken)
        self.logger.record("safety/violation_steps", self._violations)
        self._logged = (self.num_timesteps, self._violations, self._interventions)
        returns = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        mean = float(np.mean(returns)) if returns else float("nan")
        self.history.append(TrainingPoint(self.num_timesteps, mean, self._violations, self._interventions))
        if self._on_progress is not None:
            self._on_progress(self.num_timesteps - self._reported)
            self._reported = self.num_timesteps


def _batch_info(env: VecEnv) -> dict[str, np.ndarray] | None:
    """Returns the infos of the last step as arrays, None where there are only dicts."""
    while isinstance(env, VecEnvWrapper):
        env = env.venv
    return env.batch_info if isinstance(env, SB3VecEnv) else None
