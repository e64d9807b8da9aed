"""Observed exits under Gaussian noise next to the bound on their probability: a table, and a check."""

from __future__ import annotations

from collections.abc import Mapping

from experiments.analysis.escapes import rounded_up
from experiments.analysis.text_table import text_table
from experiments.attack.safety_counts import SafetyCounts
from experiments.errors import SafetyBroken

GAUSSIAN_LEGEND = """failed: episodes that left S or the box; interval: the exact 95 % interval of their probability;
bound: the union bound on it over all draws of noise, for the shielded loop;
a bound of 1 says nothing (--delta makes it small)"""


def gaussian_table(counts: Mapping[str, SafetyCounts], limits: Mapping[str, float]) -> str:
    """Returns the observed exits of each case, their exact interval and the bound on their probability, as text."""
    rows = [["case", "episodes", "failed", "interval", "bound"]]
    for name, case in counts.items():
        low, high = case.interval
        numbers = f"{case.episodes:,}", f"{case.broken_episodes:,}"
        rows.append([name, *numbers, f"[{low:.1e}, {high:.1e}]", rounded_up(limits[name])])
    return text_table(rows, rules=(1,))


def require_within(counts: Mapping[str, SafetyCounts], limits: Mapping[str, float]) -> None:
    """Returns if no case's exact interval lies above its bound.

    Raises:
        SafetyBroken: If one does: then the bound does not hold, or there is an error of one in forty per case.
    """
    for name, case in counts.items():
        if case.interval[0] > limits[name]:
            raise SafetyBroken(
                f"{name}: {case.broken_episodes:,} of {case.episodes:,} episodes left S, more than the bound "
                f"{rounded_up(limits[name])} on their probability allows"
            )
