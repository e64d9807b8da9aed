"""Stalls of a recorded network: stretches whose newest sample is older than a contract allows, and their rate."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from scipy.stats import chi2

from ncs_gym.network.contract import MAX_AGE

# The record is cut into so many parts, into twice as many, and so on, to see how unevenly stalls are spread.
_FEWEST_PARTS, _MOST_PARTS = 4, 4096
# Ages of a table: all up to the first, then these of every decade.
_ALL_UP_TO, _OF_A_DECADE = 10, (2, 5, 10)


def stalls(ages: np.ndarray, max_age: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns where ages, shape (k,), are larger than `max_age`, and for how long each, shape (stalls,) [steps]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (ages > max_age).astype(np.int8), [0]])))
    return edges[::2], edges[1::2] - edges[::2]


def count_interval(starts: np.ndarray, steps: int) -> tuple[float, float]:
    """Returns a 95 % interval for the expected number of stalls in a record as long as this one.

    Stalls, which begin at the steps `starts`, shape (n,), come in clusters. The record is cut into 4, 8, 16, ... equal
    parts, and D is the largest ratio of variance to mean of the numbers of stalls in these parts, at least 1. The n
    stalls then count as n / D independent clusters of D stalls (quasi-Poisson), for which the interval is Garwood's: D
    times the quantiles of chi-square with 2 n / D and 2 n / D + 2 degrees of freedom, halved. It assumes that the
    network goes on as in the record, that clusters are shorter than a quarter of it, and that the record has some of
    the large ones: of heavy-tailed clusters it needs twenty or more.
    """
    spread, parts = 1.0, _FEWEST_PARTS
    while len(starts) and parts <= min(_MOST_PARTS, steps):
        counts = np.bincount(starts * parts // steps, minlength=parts)
        spread, parts = max(spread, float(counts.var(ddof=1) / counts.mean())), 2 * parts
    clusters = len(starts) / spread
    low = spread * chi2.ppf(0.025, 2.0 * clusters) / 2.0 if clusters else 0.0
    return float(low), float(spread * chi2.ppf(0.975, 2.0 * clusters + 2.0) / 2.0)


def broken_contracts(ages: np.ndarray, dt: float, also: Collection[int] = ()) -> list[dict[str, Any]]:
    """Returns how often contracts would have been broken in a record, once for every stall.

    Args:
        ages: Age of the newest sample at every step, shape (k,) [steps].
        dt: Duration of a step [s].
        also: Values of `max_age` that are among them.

    Returns:
        Rows of JSON values by falling age: all ages up to 10 and some larger ones.
    """
    largest, steps = min(int(ages.max()), MAX_AGE), len(ages)
    decades = (10**power * each for power in (1, 2) for each in _OF_A_DECADE)
    chosen = {*range(_ALL_UP_TO + 1), *decades, largest, *also}
    hours = steps * dt / 3600.0
    rows = []
    for age in sorted((each for each in chosen if each <= largest or each in also), reverse=True):
        starts, lengths = stalls(ages, age)
        rows.append(
            {
                "max_age": age,
                "times": len(starts),
                "per_hour": len(starts) / hours,
                "per_hour_ci95": [bound / hours for bound in count_interval(starts, steps)],
                "longest": int(lengths.max(initial=0)),
                "broken": float(lengths.sum() / steps),
            }
        )
    return rows


def how_often(row: dict[str, Any]) -> str:
    """Returns how often the newest sample was older than a row of `broken_contracts` allows, as words."""
    low, high = map(rate_text, row["per_hour_ci95"])
    if row["times"] == 0:
        return f"at no time; a record of this length excludes more than {high} times per hour"
    times = "once" if row["times"] == 1 else f"{row['times']:,} times"
    return f"{times}, {rate_text(row['per_hour'])} per hour [{low}, {high}]"


def rate_text(rate: float) -> str:
    """Returns a rate in three digits."""
    return f"{rate:.3g}" if rate < 999.5 else f"{rate:,.0f}"
