"""How far a training got; apart from what trains, so that results are read without stable-baselines3."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainingPoint:
    """Totals so far.

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
