"""What training and evaluation return, as data that is read without stable-baselines3."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

import numpy as np

from ncs_gym.validation import counted


@dataclass(frozen=True)
class TrainingPoint:
    """Totals of a training run up to some step.

    Attributes:
        steps: Environment steps taken so far.
        episode_return: Mean return of the last finished episodes as `Monitor` counts it, with the price of violations
            (NaN before the first). It sees a shield's penalty only if it is outside the shield: with `SB3VecEnv`, not
            with `make_vec_env`.
        violation_steps: Steps so far whose true state violated the safe box.
        interventions: Steps so far in which the shield intervened.
        multiplier: Price of a violating step then, of PPO-Lagrangian; NaN in other trainings.
    """

    steps: int
    episode_return: float
    violation_steps: int
    interventions: int
    multiplier: float = nan


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One finished episode of an evaluation.

    Attributes:
        index: Number of the episode within the evaluation. With the same seed and number of episodes, episodes of equal
            index have the same start, disturbances and packet losses, whatever the policy and the shield.
        steps: Length of the episode.
        episode_return: Sum of the environment's rewards, without penalties for interventions or violations.
        violation_steps: Steps after which the true state violated the safe box.
        estimate_violation_steps: Steps after which the estimate was outside the safe box.
        interventions: Steps in which the shield intervened, or would have in mode "monitor".
        times_safe_set: The true state came to this many times the safe set, its largest gauge; above 1 it was outside.
            NaN unless `evaluate` was given a `safe_set`.
        planned: Steps after whose decision the shield of mode "lookahead" had inputs of a certified plan in store.
        guaranteed: Whether the shield's guarantee held at every step; False without a shield.
        proved: Steps after which the shield's guarantee held.
    """

    index: int
    steps: int
    episode_return: float
    violation_steps: int
    estimate_violation_steps: int
    interventions: int
    times_safe_set: float
    planned: int = 0
    guaranteed: bool
    proved: int = 0


@dataclass(frozen=True, repr=False)
class Evaluation:
    """The finished episodes of an evaluation, in order of their index."""

    episodes: list[Episode]

    def __repr__(self) -> str:
        """Short, in place of all episodes."""
        steps = sum(episode.steps for episode in self.episodes)
        violating = sum(episode.violation_steps > 0 for episode in self.episodes)
        mean = np.mean([episode.episode_return for episode in self.episodes])
        return (
            f"<Evaluation: {counted(len(self.episodes), 'episode')} of {counted(steps, 'step')} in all, {violating:,} "
            f"with a violation, mean return {mean:.4g}>"
        )
