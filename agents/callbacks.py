"""Counts what happens during training, step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback


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
    stable-baselines3 algorithm. TensorBoard gets `safety/violation_rate`, `safety/intervention_rate` (per step since
    the last log) and `safety/violation_steps` (total).

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
        for info in self.locals["infos"]:
            self._violations += int(info["cost"] > 0.0)
            self._interventions += bool(info.get("shield_intervened", False))
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
