"""Confidence intervals, and tests of the differences between arms whose runs are paired by their seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from scipy.stats import binomtest, bootstrap, sem, t, trim_mean, ttest_rel

# A number per run or episode.
Values = Sequence[float] | np.ndarray

CONFIDENCE = 0.95
RESAMPLES = 10_000
# Resamples of a single stratum held in memory at once: it may have thousands of episodes, where strata have runs.
_BATCH = 1_000
# Differences that differ by less than this fraction of the values are equal but for rounding.
_ROUNDING = 1e-12


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


def bootstrap_interval(*strata: Values, statistic: Callable[..., float] = np.mean) -> list[float] | None:
    """Returns the percentile bootstrap's 95 % interval of a statistic of all values, each stratum resampled by itself.

    With a handful of values it is too narrow: it cannot reach beyond the smallest and the largest of them. To resample
    the runs within each environment is what Agarwal et al. do, "Deep reinforcement learning at the edge of the
    statistical precipice" (2021).

    Args:
        *strata: Independent values of each stratum; a single one is the ordinary bootstrap.
        statistic: Function of an array of resampled values and the `axis` over which it is computed.

    Returns:
        The interval; None if a stratum has fewer than two values, or there is none.
    """
    if not strata or min(map(len, strata)) < 2:
        return None

    def of_all(*resampled: np.ndarray, axis: int) -> float:
        return statistic(np.concatenate(resampled, axis=axis), axis=axis)

    found = bootstrap(
        [np.asarray(values, np.float64) for values in strata],
        of_all,
        n_resamples=RESAMPLES,
        batch=_BATCH if len(strata) == 1 else RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return [float(found.low), float(found.high)]


def paired_difference(first: Values, second: Values) -> dict[str, Any]:
    """Returns mean, Student's 95 % interval and p-value of the differences first - second of paired runs.

    The p-value is that of the two-sided paired t-test. Where all differences are equal the test does not apply: the
    p-value is then 1 if they are zero, and else that of the sign-flip test, 2^(1 - runs). Interval and p-value are None
    for fewer than two runs.

    Args:
        first: A number per run.
        second: Numbers of the runs with the same seeds.

    Raises:
        ValueError: If there are not equally many numbers, or none.
    """
    if len(first) != len(second) or len(first) == 0:
        raise ValueError(f"paired runs must be equally many, at least one, got {len(first)} and {len(second)}")
    differences = np.subtract(first, second, dtype=np.float64)
    if len(differences) < 2:
        p_value = None
    elif np.ptp(differences) <= _ROUNDING * max(np.abs(first).max(), np.abs(second).max()):
        p_value = 1.0 if np.array_equal(first, second) else 2.0 ** (1 - len(differences))
    else:
        p_value = float(ttest_rel(first, second).pvalue)
    return {"mean": float(differences.mean()), "ci95": mean_interval(differences), "p": p_value}


def holm(p_values: Sequence[float]) -> list[float]:
    """Returns p-values adjusted for their number, in the same order.

    Rejecting what is adjusted to at most alpha keeps the probability of any false rejection below alpha, however the
    tests depend on each other (Holm: "A simple sequentially rejective multiple test procedure", 1979).

    Args:
        p_values: Between 0 and 1.
    """
    p, order = np.asarray(p_values, np.float64), np.argsort(p_values)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)))
    return adjusted.tolist()


def all_pairs(values: Mapping[str, Values]) -> list[dict[str, Any]]:
    """Returns the difference of every pair of arms, with the p-values that Holm's method adjusts over all pairs.

    Args:
        values: A number per run of each arm, paired by position.

    Returns:
        JSON values per pair: first, second, what `paired_difference` returns, and p_holm (None for single runs).
    """
    pairs: list[dict[str, Any]] = [
        {"first": one, "second": other} | paired_difference(values[one], values[other]) | {"p_holm": None}
        for one, other in combinations(values, 2)
    ]
    tested = [pair for pair in pairs if pair["p"] is not None]
    for pair, adjusted in zip(tested, holm([pair["p"] for pair in tested]), strict=True):
        pair["p_holm"] = adjusted
    return pairs
