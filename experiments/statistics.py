"""Intervals that a reader can check."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import beta, t

CONFIDENCE = 0.95


def clopper_pearson(events: int, trials: int) -> tuple[float, float]:
    """Returns the exact 95 % interval of a probability after `events` in `trials` independent trials.

    Raises:
        ValueError: Unless 0 <= events <= trials and trials >= 1.
    """
    if not 0 <= events <= trials or trials < 1:
        raise ValueError(f"events must be between 0 and trials >= 1, got {events} of {trials}")
    tail = (1.0 - CONFIDENCE) / 2.0
    low = float(beta.ppf(tail, events, trials - events + 1)) if events > 0 else 0.0
    high = float(beta.ppf(1.0 - tail, events + 1, trials - events)) if events < trials else 1.0
    return low, high


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Returns Student's 95 % interval of the mean of independent values; None for fewer than two."""
    if len(values) < 2:
        return None
    half = float(t.ppf(0.5 + CONFIDENCE / 2.0, len(values) - 1)) * float(np.std(values, ddof=1)) / len(values) ** 0.5
    mean = float(np.mean(values))
    return mean - half, mean + half
