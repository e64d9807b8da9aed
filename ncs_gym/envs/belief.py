"""What a controller can know of a loop, or of N."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym.estimation.arrival_histories import ErrorTable
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
    def error_shape(self) -> np.ndarray:
        """Sigma_k, shape (n, n) and read-only, or a fresh array of shape (N, n, n)."""
        if self.estimate.ndim == 1:
            return self.table.shape(self.number)
        return self.table.shapes.take(self.number, axis=0)


def _loaded_belief(*values: Any) -> Belief:
    return Belief._make(frozen(each) if isinstance(each, np.ndarray) else each for each in values)
