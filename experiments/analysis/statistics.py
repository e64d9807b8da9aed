"""Confidence intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import binomtest, bootstrap, sem, t, trim_mean

# A number per run or episode.
Values = Sequence[float] | np.ndarray

CONFIDENCE = 0.95
RESAMPLES = 10_000
# Resamples held in memory at once.
_BATCH = 1_000


def clopper_pearson(events: int, trials: int) -> list[float]:
    """Returns the exact 95 % interval of a probability after `events` in `trials` independent trials.

    Raises:
        ValueError: Unless 0 <= events <= trials and trials >= 1.
    """
    if not 0 <= events <= trials or trials < 1:
        raise ValueError(f"events must be between 0 and trials >= 1, got {events} of {trials}")
    interval = binomtest(events, trials).proportion_ci(CONFIDENCE, "exact")
    return [float(interval.low), float(interval.high)]


def mean_interval(values: Values) -> list[float] | None:
    """Returns Student's 95 % interval of the mean of independent values; None for fewer than two."""
    if len(values) < 2:
        return None
    half = t.ppf(0.5 + CONFIDENCE / 2.0, len(values) - 1) * sem(values)
    return [float(np.mean(values) - half), float(np.mean(values) + half)]


def interquartile_mean(values: Values, axis: int = -1) -> float:
    """Returns the mean without the lowest and the highest quarter of the values (rounded down)."""
    return trim_mean(values, 0.25, axis=axis)


def bootstrap_interval(values: Values, statistic: Callable[..., float] = np.mean) -> list[float] | None:
    """Returns the percentile bootstrap's 95 % interval of a statistic of independent values; None for fewer than two.

    With a handful of values it is too narrow: it cannot reach beyond the smallest and the largest of them.
    """
    if len(values) < 2:
        return None
    found = bootstrap(
        [np.asarray(values, np.float64)],
        statistic,
        n_resamples=RESAMPLES,
        batch=_BATCH,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return [float(found.low), float(found.high)]
