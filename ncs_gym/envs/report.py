"""What is told of a control loop, or of N: what a controller can know, and what happened."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.estimation.arrival_histories import ErrorTable
from ncs_gym.network.channel import Channel
from ncs_gym.validation import frozen


class Belief(NamedTuple):
    """What a controller can know of a loop now; of N loops, arrays whose last axis is the loop.

    A shield takes what it decides on from here, never from an `info`, into which wrappers may have written. Nobody
    writes into the arrays.

    Attributes:
        estimate: x_hat of the time at which the next decision takes effect, shape (n,) or (n, N).
        number: Number of the ellipsoid Sigma_k that holds its error, an int or shape (N,).
        table: What gives that number its meaning; another one after shapes were forgotten.
        age: Steps since the newest sample used was taken, an int or shape (N,).
        alarm: Whether an assumption was seen to be violated, a bool or shape (N,).
        damaged: Whether one was because a sample was no finite numbers, likewise.
        outside: Whether `alarm` is also about a step of the process outside E(D), likewise.
        applied: The input applied in the last step, shape (m,) or (m, N) [physical units]; zeros at a reset.
        committed: The input decided in the last step, of the same shape.
        moves: Steps and resets of this loop since it was made, an int or shape (N,): the one clock.
    """

    estimate: np.ndarray
    number: Any
    table: ErrorTable
    age: Any
    alarm: Any
    damaged: Any
    outside: Any
    applied: np.ndarray
    committed: np.ndarray
    moves: Any = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> Belief:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return _loaded_belief, tuple(self)

    @property
    def stays(self) -> Any:
        """Whether an error in a certified set is known to stay there while the contract is kept, of one loop or N."""
        if self.estimate.ndim == 1:
            return self.table.is_certified(self.number)
        return self.table.certified.take(self.number)

    @property
    def error_shape(self) -> np.ndarray:
        """Sigma_k, shape (n, n) and read-only, or a fresh array of shape (N, n, n)."""
        if self.estimate.ndim == 1:
            return self.table.shape(self.number)
        return self.table.shapes.take(self.number, axis=0)


def _loaded_belief(*values: Any) -> Belief:
    return Belief._make(frozen(each) if isinstance(each, np.ndarray) else each for each in values)


class Beginning(NamedTuple):
    """What a guard is told where episodes begin.

    Attributes:
        belief: What a controller can know.
        start: What the start is known to lie in, an ellipsoid or the state itself; of N loops, states that episodes
            were started at by an option or outside the initial set, NaN elsewhere, shape (N, n).
        earlier: Estimate and number of the error set of every step before the first decision takes effect; of N loops
            of those that begin alone.
        channels: Those of the present episodes.
    """

    belief: Belief
    start: Any
    earlier: list[tuple[np.ndarray, Any]]
    channels: Sequence[Channel]


class Report(NamedTuple):
    """What happened in a step of a loop; of N loops, arrays whose last axis is the loop.

    Attributes:
        belief: What a controller can know; the rest is true besides.
        steps: Steps taken in the episode, an int or shape (N,).
        state: x, shape (n,) or (n, N).
        mean: x_hat now, also behind a downlink, of the same shape.
        arrived: Whether a packet arrived at this step, a bool or shape (N,).
        packets: Samples sent in the episode, an int or shape (N,).
        values: How far c_j x is beyond a limit now, shape (k,) or (k, N).
        worst: The largest since the last step, and those of limits of x and u, shape (k + q,) or (k + q, N).
        cost: 1.0 if one of these is positive, else 0.0, a float or shape (N,).
        violations: The sum of costs in the episode, likewise.
        missing: Whether zero was applied because the input committed had not arrived, a bool or shape (N,).
        requested: Whether a sample was requested, likewise.
        forced: Whether that was so only because the contract needs it, likewise.
        others: Infos about the episode: its channels, the parameters of the member of a family.
    """

    belief: Belief
    steps: Any
    state: np.ndarray
    mean: np.ndarray
    arrived: Any
    packets: Any
    values: np.ndarray
    worst: np.ndarray
    cost: Any
    violations: Any
    missing: Any
    requested: Any
    forced: Any
    others: dict[str, Any]
