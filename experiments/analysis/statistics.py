"""Confidence intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import binomtest, bootstrap, t, trim_mean

CONFIDENCE = 0.95
RESAMPLES = 10_000
# Resamples held in memory at once.
_BATCH = 1_000


def clopper_pearson(events: int, trials: int) -> tuple[float, float]:
    """Returns the exact 95 % interval of a probability after `events` in `trials` independent trials.

    Raises:
        ValueError: Unless 0 <= events <= trials and trials >= 1.
    """
    if not 0 <= events <= trials or trials < 1:
        raise ValueError(f"events must be between 0 and trials >= 1, got {events} of {trials}")
    interval = binomtest(events, trials).proportion_ci(CONFIDENCE, "exact")
    return float(interval.low), float(interval.high)


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

    With a handful of values it is too narrow: it cannot reach beyond the smallest and the largest of them.

    Args:
        values: Independent values.
        statistic: Function of an array of resampled values and the `axis` over which it is computed.
    """
    return _percentile_interval([values], statistic, _BATCH)


def stratified_interval(
    strata: Sequence[Sequence[float]], statistic: Callable[..., float] = interquartile_mean
) -> tuple[float, float] | None:
    """Returns the percentile bootstrap's 95 % interval of a statistic of all values, each stratum resampled by itself.

    This is how Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice" (2021), resample:
    the runs within each task. None if a stratum has fewer than two values.

    Args:
        strata: Values of the runs in each environment.
        statistic: Function of an array of resampled values and the `axis` over which it is computed.
    """

    def of_all(*resampled: np.ndarray, axis: int) -> float:
        return statistic(np.concatenate(resampled, axis=axis), axis=axis)

    return _percentile_interval(strata, of_all, RESAMPLES)


def _percentile_interval(
    strata: Sequence[Sequence[float]], statistic: Callable[..., float], batch: int
) -> tuple[float, float] | None:
    """Returns the interval of a function of the resampled strata and an `axis`; None for fewer than two values."""
    if not strata or min(map(len, strata)) < 2:
        return None
    found = bootstrap(
        [np.asarray(values, np.float64) for values in strata],
        statistic,
        n_resamples=RESAMPLES,
        batch=batch,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(found.low), float(found.high)
