"""The distinct error statistics met so far, and what a prediction and an update make of each, worked out once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.estimation.innovation_test import InnovationTest
from ncs_gym.estimation.kalman_filter import ErrorRecursion, ErrorStatistics
from ncs_gym.validation import frozen, read_only

# Number of what is not worked out yet.
UNKNOWN = -1
# Number of the statistics that stand for "no sample is used here": their gain is zero.
NO_SAMPLE = 0
# Entries that arrays begin with; they double when they are full.
_FIRST_CAPACITY = 256


class NumberedUpdate(NamedTuple):
    """What using a sample makes of statistics in the table.

    Attributes:
        after: Number of the statistics afterwards; the same where the sample must not be used.
        gain: Shape (n, p); zero where the sample must not be used.
        quick_test: W, shape (p, p), of the quick innovation test.
    """

    after: int
    gain: np.ndarray
    quick_test: np.ndarray


class StatisticsTable:
    """Error statistics by number, for one estimator at a time and as arrays for many.

    Statistics are rounded by the recursion, so that they recur; equal ones are one. Reading what is there needs no
    lock; whoever adds to the table holds that of the graph it belongs to.

    Args:
        recursion: Moves the error statistics.
        oldest: Ages above this make no difference.

    Attributes:
        statistics: By number; the first stands for NO_SAMPLE.
        test: The innovation test.
        gains: Shape (n, p, capacity), zero until an update is worked out.
        quick_tests: W of the quick innovation test, shape (p, p, capacity), zero until an update is worked out.
    """

    def __init__(self, recursion: ErrorRecursion, oldest: int) -> None:
        plant = recursion.plant
        self.recursion, self._oldest = recursion, oldest
        self.test = InnovationTest(plant.H, recursion.sets.noise)
        self.statistics: list[ErrorStatistics] = []
        self._numbers: dict[tuple[bytes, bytes, int], int] = {}
        self._predictions: list[int] = []
        self._updates: list[NumberedUpdate | None] = []
        self._axes: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._shapes = np.zeros((_FIRST_CAPACITY, plant.n, plant.n))
        self.gains = np.zeros((plant.n, plant.p, _FIRST_CAPACITY))
        self.quick_tests = np.zeros((plant.p, plant.p, _FIRST_CAPACITY))
        covariance, shape, age = recursion.first
        self._add(
            ErrorStatistics(read_only(covariance), read_only(shape), age)
        )  # NO_SAMPLE, which no other statistics are equal to
        self._updates[NO_SAMPLE] = NumberedUpdate(NO_SAMPLE, self.gains[..., 0].copy(), self.quick_tests[..., 0].copy())

    @property
    def shapes(self) -> np.ndarray:
        """The error shapes Sigma_k by number, shape (count, n, n), read-only: many estimators share them."""
        return frozen(self._shapes[: len(self.statistics)])

    def age_matters(self, age: int) -> bool:
        """Returns whether an age is told apart from all larger ones."""
        return age < self._oldest

    def number_of(self, statistics: ErrorStatistics) -> int:
        """Returns the number of statistics, a new one if they have not occurred."""
        covariance, shape, age = statistics
        age = min(age, self._oldest)
        key = covariance.tobytes(), shape.tobytes(), age
        if key not in self._numbers:
            self._numbers[key] = self._add(ErrorStatistics(read_only(covariance), read_only(shape), age))
        return self._numbers[key]

    def predicted(self, number: int) -> int:
        """Returns the number of the statistics one step later."""
        if self._predictions[number] == UNKNOWN:
            self._predictions[number] = self.number_of(self.recursion.predicted(self.statistics[number]))
        return self._predictions[number]

    def known_update(self, number: int) -> NumberedUpdate | None:
        """Returns what an update makes of some statistics, if that is worked out."""
        return self._updates[number]

    def update(self, number: int) -> NumberedUpdate:
        """Returns what an update makes of some statistics."""
        found = self._updates[number]
        if found is None:
            statistics, plant = self.statistics[number], self.recursion.plant
            update = self.recursion.updated(statistics)
            quick_test = self.test.inverse_of_bound(self.test.spread(statistics.shape))
            if update is None:
                found = NumberedUpdate(number, np.zeros((plant.n, plant.p)), quick_test)
            else:
                found = NumberedUpdate(self.number_of(update.statistics), update.gain, quick_test)
            self.gains[:, :, number], self.quick_tests[:, :, number] = found.gain, quick_test
            self._updates[number] = found
        return found

    def innovation_axes(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the axes in which residuals before an update of some statistics are tested exactly."""
        if number not in self._axes:
            self._axes[number] = self.test.axes(self.test.spread(self.statistics[number].shape))
        return self._axes[number]

    def _add(self, statistics: ErrorStatistics) -> int:
        """Returns the number of new statistics."""
        number = len(self.statistics)
        if number == len(self._shapes):  # which grow last: if growing is interrupted, it begins again
            self.gains = np.concatenate([self.gains, np.zeros_like(self.gains)], axis=-1)
            self.quick_tests = np.concatenate([self.quick_tests, np.zeros_like(self.quick_tests)], axis=-1)
            self._shapes = np.concatenate([self._shapes, np.zeros_like(self._shapes)])
        self._shapes[number] = statistics.shape
        self._predictions.append(UNKNOWN)
        self._updates.append(None)
        self.statistics.append(statistics)
        return number
