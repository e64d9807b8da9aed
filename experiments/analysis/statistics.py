"""Intervals that a reader can check."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import beta, t, trim_mean

CONFIDENCE = 0.95
RESAMPLES = 10_000


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


def interquartile_mean(values: Sequence[float], axis: int = -1) -> float:
    """Returns the mean without the lowest and the highest quarter of the values (rounded down)."""
    return trim_mean(values, 0.25, axis=axis)


def bootstrap_interval(
    values: Sequence[float], statistic: Callable[..., float] = np.mean
) -> tuple[float, float] | None:
    """Returns the percentile bootstrap's 95 % interval; None for fewer than two values.

    With a handful of values it is too narrow: with n of them it cannot reach beyond the smallest and the largest.

    Args:
        values: Independent values.
        statistic: Takes (resamples, values) and `axis`.
    """
    if len(values) < 2:
        return None
    rng = np.random.default_rng(0)
    drawn = np.asarray(values)[rng.integers(len(values), size=(RESAMPLES, len(values)))]
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(statistic(drawn, axis=1), [tail, 100.0 - tail])
    return float(low), float(high)
