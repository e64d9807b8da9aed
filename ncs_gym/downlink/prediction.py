"""Error statistics some steps ahead, looked up by number for many environments."""

from __future__ import annotations

import numpy as np

from ncs_gym.estimation.arrival_patterns import ArrivalPatterns
from ncs_gym.estimation.error_statistics_table import UNKNOWN


class PredictedStatistics:
    """Numbers of the error statistics c steps ahead, remembered by the numbers of the present ones.

    Args:
        lead: c.
    """

    def __init__(self, lead: int) -> None:
        self._lead = lead
        self._patterns: ArrivalPatterns | None = None
        self._ahead = np.full(0, UNKNOWN)

    def of(self, patterns: ArrivalPatterns, numbers: np.ndarray) -> np.ndarray:
        """Returns the numbers, shape (N,), of what `lead` predictions make of the statistics with these numbers.

        Args:
            patterns: The graph whose table the numbers are of.
            numbers: Shape (N,).
        """
        if patterns is not self._patterns:
            self._patterns, self._ahead = patterns, np.full(0, UNKNOWN)
        count = len(patterns.table.statistics)
        if count > len(self._ahead):
            self._ahead = np.concatenate([self._ahead, np.full(count, UNKNOWN)])
        ahead = self._ahead.take(numbers)
        missing = ahead == UNKNOWN
        if missing.any():
            for number in np.unique(numbers[missing]).tolist():
                self._ahead[number] = patterns.predicted(number, self._lead)
            ahead = self._ahead.take(numbers)
        return ahead
