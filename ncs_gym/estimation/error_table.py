"""The distinct error statistics that estimators meet, by number, and what predictions and updates make of each.

They are kept in a few large arrays: many small objects would keep the garbage collector busy.
"""

from __future__ import annotations

from hashlib import blake2b
from typing import Any

import numpy as np

from ncs_gym.estimation.innovation import common_axes, quick_test
from ncs_gym.estimation.kalman_filter import ErrorRecursion, ErrorStatistics
from ncs_gym.validation import frozen

# Number of what is not worked out yet, and of "no sample is used here", whose gain is zero.
UNKNOWN, NO_SAMPLE = -1, 0
# Numbers that arrays have room for to begin with.
FIRST_CAPACITY = 256
# What a dictionary takes for a key of bytes and its number, without those bytes.
BYTES_PER_KEY = 150
# Bytes of the hash that statistics are found by.
_HASH_SIZE = 16
# The arrays of a table, whose last or first axis is the number.
_BY_NUMBER_LAST = "gains", "quick_tests"
_BY_NUMBER = (
    *("_gains", "_by_columns", "_quick_tests", "_covariances", "_shapes"),
    *("_after_step", "_after_update", "_certified", "_ages"),
)


class ErrorTable:
    """The distinct error statistics met so far, and what a prediction and an update make of each, worked out once.

    The recursion rounds statistics, so that they recur; equal ones have one number. Who adds to the table holds the
    lock of its graph.

    Attributes:
        recursion: Moves the error statistics.
        oldest: Ages above this make no difference.
        gains: Of an update, by number, shape (n, p, capacity); zero until it is worked out.
        quick_tests: W of the quick innovation test, by number, shape (p, p, capacity); zero until it is worked out.
    """

    def __init__(self, recursion: ErrorRecursion, oldest: int) -> None:
        n, p, size = recursion.plant.n, recursion.plant.p, FIRST_CAPACITY
        self.recursion, self.oldest = recursion, oldest
        self._count = 0
        self._numbers: dict[bytes, int] = {}
        self._axes: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.gains, self.quick_tests = np.zeros((n, p, size)), np.zeros((p, p, size))
        self._ages, self._after_step, self._after_update = np.zeros((3, size), np.int64)
        # The same once more, for one at a time. Gains in the order in memory in which they were made: the last bit of a
        # product depends on it, and who runs an experiment again expects the same numbers.
        self._gains, self._by_columns = np.zeros((size, n * p)), np.zeros(size, np.bool_)
        self._quick_tests = np.zeros((size, p, p))
        self._covariances, self._shapes = np.zeros((2, size, n, n))
        self._certified = np.zeros(size, np.bool_)
        self._after_update[self._add(recursion.first)] = NO_SAMPLE  # which no other statistics are equal to

    def __len__(self) -> int:
        return self._count

    def __deepcopy__(self, memo: dict[int, Any]) -> ErrorTable:
        return self  # shared by all estimators

    @property
    def bytes_each(self) -> int:
        """What the statistics of one number take, about [bytes]."""
        n, p = self.recursion.plant.n, self.recursion.plant.p
        return BYTES_PER_KEY + _HASH_SIZE + 8 * (2 * n**2 + 2 * n * p + 2 * p**2 + 3) + 2

    @property
    def shapes(self) -> np.ndarray:
        """The error shapes Sigma_k by number, shape (count, n, n), read-only."""
        return frozen(self._shapes[: self._count])

    @property
    def certified(self) -> np.ndarray:
        """`ErrorStatistics.certified` by number, shape (count,), read-only."""
        return frozen(self._certified[: self._count])

    def is_certified(self, number: int) -> bool:
        """Returns `ErrorStatistics.certified` of a number."""
        return self._certified.item(number)

    def shape(self, number: int) -> np.ndarray:
        """Returns an error shape Sigma_k, shape (n, n), read-only."""
        shape = self._shapes[number]
        shape.flags.writeable = False
        return shape

    def statistics(self, number: int) -> ErrorStatistics:
        """Returns statistics by their number, read-only.

        They are copies: on some processors the last bit of a sum depends on where in memory its terms lie.
        """
        covariance, shape = self._covariances[number].copy(), self._shapes[number].copy()
        return ErrorStatistics(frozen(covariance), frozen(shape), self._ages.item(number), self._certified.item(number))

    def number_of(self, statistics: ErrorStatistics) -> int:
        """Returns the number of statistics, a new one if they have not occurred."""
        age = min(statistics.age, self.oldest)
        small = age.to_bytes(4, "little") + bytes([statistics.certified])
        whole = b"".join((statistics.covariance.tobytes(), statistics.shape.tobytes(), small))
        key = blake2b(whole, digest_size=_HASH_SIZE).digest()
        number = self._numbers.get(key)
        if number is None:
            number = self._add(statistics._replace(age=age))
            self._numbers[key] = number  # last: if this is interrupted, the statistics have not occurred
        return number

    def after_step(self, number: int) -> int:
        """Returns the number of the statistics one step later."""
        after = self._after_step.item(number)
        if after == UNKNOWN:
            after = self.number_of(self.recursion.predicted(self.statistics(number)))
            self._after_step[number] = after
        return after

    def after_update(self, number: int) -> int:
        """Returns the number of the statistics after an update; the same where the sample must not be used."""
        after = self._after_update.item(number)
        if after == UNKNOWN:
            statistics, after = self.statistics(number), number
            weight = quick_test(self._spread(statistics.shape), self.recursion.sets.noise)
            if (update := self.recursion.updated(statistics)) is not None:
                gain, updated = update
                after = self.number_of(updated)
                self.gains[..., number], self._gains[number] = gain, gain.ravel(order="K")
                self._by_columns[number] = not gain.flags.c_contiguous
            self.quick_tests[..., number] = self._quick_tests[number] = weight
            self._after_update[number] = after  # last: another thread may look it up, and then wants the rest too
        return after

    def update(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the gain of an update that is worked out, (n, p), zero if the sample is not used, and W, (p, p)."""
        gain, (n, p, _) = self._gains[number], self.gains.shape
        gain = gain.reshape(p, n).T if self._by_columns[number] else gain.reshape(n, p)
        return gain, self._quick_tests[number]

    def innovation_axes(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns `common_axes` for residuals before an update of some statistics."""
        if number not in self._axes:
            self._axes[number] = common_axes(self._spread(self.shape(number)), self.recursion.sets.noise)
        return self._axes[number]

    def _spread(self, shape: np.ndarray) -> np.ndarray:
        H = self.recursion.plant.H
        return H @ shape @ H.T

    def _add(self, statistics: ErrorStatistics) -> int:
        number = self._count
        if number == len(self._ages):
            for name in _BY_NUMBER_LAST:
                setattr(self, name, with_room(getattr(self, name)))
            for name in _BY_NUMBER:  # the last one tells how much
                setattr(self, name, with_room(getattr(self, name), axis=0))
        self._covariances[number], self._shapes[number], self._ages[number], self._certified[number] = statistics
        self._after_step[number] = self._after_update[number] = UNKNOWN
        self._gains[number], self._by_columns[number] = 0.0, False
        self.gains[..., number] = 0.0
        self._count = number + 1
        return number


def with_room(array: np.ndarray, axis: int = -1) -> np.ndarray:
    """Returns an array with room for twice as many numbers along an axis."""
    return np.concatenate([array, np.zeros_like(array)], axis=axis)
