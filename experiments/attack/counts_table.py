"""The counts of a campaign as a table: of the shields that keep S, and of mode "lookahead", which keeps the box."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from experiments.analysis.text_table import text_table
from experiments.attack.monte_carlo_batch import SETTLING_STEPS
from experiments.attack.safety_counts import SafetyCounts

# Text of a column by the two lines of its header.
_Columns = dict[tuple[str, str], Callable[[SafetyCounts], str]]

_SET_COLUMNS: _Columns = {
    ("", "steps"): lambda counts: f"{counts.steps:,}",
    ("outside", "S"): lambda counts: f"{counts.exits:,}",
    ("outside", "box"): lambda counts: f"{counts.violations:,}",
    ("", "episodes"): lambda counts: f"{counts.episodes:,}",
    ("", "failed"): lambda counts: f"{counts.broken_episodes:,}",
    ("", "p <"): lambda counts: f"{counts.bound:.1e}",
    ("", "margin"): lambda counts: f"{counts.margin:.1e}",
    ("over-", "ridden"): lambda counts: f"{counts.interventions / counts.steps:.1%}",
}
_BOX_COLUMNS: _Columns = {
    ("", "steps"): _SET_COLUMNS[("", "steps")],
    ("outside", "S"): lambda counts: f"{counts.exits / counts.steps:.1%}",
    ("outside", "box"): _SET_COLUMNS[("outside", "box")],
    ("", "episodes"): _SET_COLUMNS[("", "episodes")],
    ("from", "outside S"): lambda counts: f"{counts.outside_starts:,}",
    ("", "failed"): _SET_COLUMNS[("", "failed")],
    ("", "p <"): _SET_COLUMNS[("", "p <")],
    ("", "margin"): _SET_COLUMNS[("", "margin")],
    ("", "planned"): lambda counts: f"{counts.planned / counts.steps:.1%}",
    ("over-", "ridden"): _SET_COLUMNS[("over-", "ridden")],
}
_SET_LEGEND = f"""\
failed: episodes that left S or the box; p <: upper end of the exact 95 % interval of their probability;
margin: smallest 1 - sqrt(x'Mx) from step {SETTLING_STEPS} on (episodes start on the boundary); overridden: steps that
the shield changed or, unshielded, would have changed"""
_BOX_LEGEND = f"""\
outside S: steps there, which lookahead allows; from outside S: episodes that began there with a certified plan;
failed: episodes that left the box; p <: upper end of the exact 95 % interval of their probability;
margin: smallest 1 - |c_j x| from step {SETTLING_STEPS} on; planned: steps with inputs of a certified plan in store;
overridden: steps that the shield changed"""


def counts_table(counts: Mapping[str, SafetyCounts], *, looks_ahead: bool) -> str:
    """Returns the counts as text, with a legend; a rule stands above the last row.

    Args:
        counts: Counts by the name of their row.
        looks_ahead: Whether the shield was that of mode "lookahead".
    """
    columns, legend = (_BOX_COLUMNS, _BOX_LEGEND) if looks_ahead else (_SET_COLUMNS, _SET_LEGEND)
    rows = [list(line) for line in zip(("", "case"), *columns, strict=True)]
    rows += [[name, *(text_of(case) for text_of in columns.values())] for name, case in counts.items()]
    return f"{text_table(rows, rules=(2, len(rows) - 1))}\n{legend}"
