"""What training and evaluation return, as data that is read without stable-baselines3."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import nan

import numpy as np

from agents.loop import LoopConfig
from ncs_gym.validation import counted

# File beside a checkpoint with the totals of its training.
HISTORY_FILE = "history.json"


class TrainingStopped(RuntimeError):
    """Ends a training from a callback as Ctrl-C does: what was learned is kept."""


class _Totals:
    """Mixin of dataclasses of numbers, in which NaN is equal to NaN."""

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return all(one == two or (one != one and two != two) for one, two in pairs)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class TrainingPoint(_Totals):
    """Totals of a training run up to some step.

    Attributes:
        steps: Environment steps taken so far.
        episode_return: Mean return of the last finished episodes as `Monitor` counts it, with the price of violations.
            It sees a shield's penalty only if it is outside the shield: with `SB3VecEnv`, not with `make_vec_env` (NaN
            before the first).
        violation_steps: Steps so far whose true state violated the safe box.
        interventions: Steps so far in which the shield intervened.
        multiplier: Price of a violating step then, of PPO-Lagrangian; NaN in other trainings.
    """

    steps: int
    episode_return: float
    violation_steps: int
    interventions: int
    multiplier: float = nan


def history_document(history: Sequence[TrainingPoint]) -> str:
    """Returns totals as JSON, NaN as null."""
    points = [{name: None if value != value else value for name, value in asdict(point).items()} for point in history]
    return json.dumps(points, allow_nan=False) + "\n"


@dataclass(frozen=True, eq=False)
class Episode(_Totals):
    """One finished episode of an evaluation.

    Attributes:
        index: Number of the episode within the evaluation. With the same seed and number of episodes, episodes of equal
            index have the same start, disturbances and packet losses, whatever the policy and the shield.
        steps: Length of the episode.
        episode_return: Sum of the environment's rewards, without penalties for interventions or violations.
        violation_steps: Steps after which the true state violated the safe box.
        estimate_violation_steps: Steps after which the estimate was outside the safe box.
        interventions: Steps in which the shield intervened, or would have in mode "monitor".
        guaranteed: Whether the shield's guarantee held at every step; False without a shield.
        times_safe_set: The true state came to this many times the safe set: the root of the largest x'Mx, or the
            largest gauge in a polytope; above 1 it was outside. NaN unless `evaluate` was given a `safe_set`.
        planned: Steps after whose decision the shield of mode "lookahead" had inputs of a certified plan in store; 0 in
            other modes.
        proved: Steps after which the shield's guarantee held; 0 without a shield.
    """

    index: int
    steps: int
    episode_return: float
    violation_steps: int
    estimate_violation_steps: int
    interventions: int
    guaranteed: bool
    times_safe_set: float
    planned: int = 0
    proved: int = 0


@dataclass(frozen=True, repr=False)
class Evaluation:
    """The finished episodes of an evaluation.

    Attributes:
        loop: The control loop that they were played in, but for its penalties.
        episodes: All episodes, in order of their index.
    """

    loop: LoopConfig
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
