"""Differences between arms whose runs are paired by their seeds, and a correction for comparing many of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from scipy.stats import ttest_rel

from experiments.analysis.statistics import mean_interval

# Differences that differ by less than this fraction of the values are equal but for rounding.
_ROUNDING = 1e-12


def paired_difference(first: Sequence[float], second: Sequence[float]) -> dict[str, Any]:
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
    differences = np.subtract(first, second, dtype=np.float64) if len(first) == len(second) else np.empty(0)
    if len(differences) == 0:
        raise ValueError(f"paired runs must be equally many, at least one, got {len(first)} and {len(second)}")
    interval = mean_interval(differences.tolist())
    return {
        "mean": float(differences.mean()),
        "ci95": None if interval is None else list(interval),
        "p": _p_value(first, second, differences),
    }


def holm(p_values: Sequence[float]) -> list[float]:
    """Returns p-values adjusted for their number, in the same order.

    Rejecting what is adjusted to at most alpha keeps the probability of any false rejection below alpha, however the
    tests depend on each other (Holm: "A simple sequentially rejective multiple test procedure", 1979).

    Args:
        p_values: Between 0 and 1.
    """
    adjusted, largest, count = [0.0] * len(p_values), 0.0, len(p_values)
    for rank, index in enumerate(sorted(range(count), key=lambda i: p_values[i])):
        largest = max(largest, min(1.0, (count - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def all_pairs(values: Mapping[str, Sequence[float]]) -> list[dict[str, Any]]:
    """Returns the difference of every pair of arms, with the p-values that Holm's method adjusts over all pairs.

    Args:
        values: A number per run of each arm, paired by position.

    Returns:
        JSON values per pair: first, second, what `paired_difference` returns, and p_holm (None for single runs).
    """
    pairs: list[dict[str, Any]] = [
        {"first": one, "second": other} | paired_difference(values[one], values[other])
        for one, other in combinations(values, 2)
    ]
    tested = [pair for pair in pairs if pair["p"] is not None]
    adjusted = holm([pair["p"] for pair in tested])
    for pair in pairs:
        pair["p_holm"] = None
    for pair, p_value in zip(tested, adjusted, strict=True):
        pair["p_holm"] = p_value
    return pairs


def _p_value(first: Sequence[float], second: Sequence[float], differences: np.ndarray) -> float | None:
    """Returns the two-sided p-value; see `paired_difference`."""
    runs = len(differences)
    if runs < 2:
        return None
    if np.ptp(differences) <= _ROUNDING * max(np.abs(first).max(), np.abs(second).max()):
        return 1.0 if np.array_equal(first, second) else 2.0 ** (1 - runs)
    return float(ttest_rel(first, second).pvalue)
