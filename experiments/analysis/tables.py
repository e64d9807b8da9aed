"""The tables of results on a terminal, at most 100 columns wide for the usual names."""

from __future__ import annotations

from collections.abc import Mapping
from math import floor, log10
from typing import Any

from experiments.terminal import text_table

_HEADERS = (
    ("", "training:", "", "evaluation:", "", "", "", ""),
    ("", "violating", "over-", "violating", "violating", "left", "over-", "return"),
    ("", "steps", "ridden", "episodes", "steps", "S", "ridden", "[95 % CI]"),
)
# Number of columns after the first that are about the training.
_TRAINING_COLUMNS = 2
_MOST_DECIMALS = 4
# Two lines of the header of what a point of a sweep fixes, by its key.
_SIDES = {
    "loss": ("", "loss"),
    "downlink_loss": ("commands", "lost"),
    "delay": ("", "delay"),
    "quantization_step": ("quanti-", "zation"),
    "burst_length": ("", "burst"),
    "mass_factor": ("", "mass"),
}
_OUTCOMES = (
    ("", "arm"),
    ("violating", "episodes"),
    ("violating", "training steps"),
    ("over-", "ridden"),
    ("", "return"),
)


def summary_text(arms: dict[str, dict[str, Any]], baselines: dict[str, dict[str, Any]]) -> str:
    """Returns the table for a terminal; baselines stand below a rule.

    Violating episodes have their exact interval, the return has Student's (`experiments.analysis.episodes`). "Left S"
    counts episodes in which the true state was outside the safe set at some step, "from a plan" the steps after whose
    decision the shield of mode "lookahead" had inputs of a certified plan in store. The columns about the training are
    left out where nothing was trained.
    """
    rows = _rows(arms | baselines)
    if not any(arm["train_steps"] for arm in (arms | baselines).values()):
        rows = _without_training(rows)
    return text_table(rows, rules=(len(_HEADERS), len(_HEADERS) + len(arms)))


def scenario_text(scenario: str, arms: dict[str, dict[str, Any]], baselines: dict[str, dict[str, Any]]) -> str:
    """Returns the table of the evaluation in a scenario, with its name in the corner."""
    rows = _rows({name: arm | arm["conditions"][scenario] for name, arm in (arms | baselines).items()})
    rows = _without_training(rows)
    rows[0] = [f"{scenario}:", *[""] * (len(rows[0]) - 1)]
    return text_table(rows, rules=(len(_HEADERS), len(_HEADERS) + len(arms)))


def _without_training(rows: list[list[str]]) -> list[list[str]]:
    return [[row[0], *row[1 + _TRAINING_COLUMNS :]] for row in rows]


def _with_plans(rows: list[list[str]], arms: Mapping[str, dict[str, Any]]) -> list[list[str]]:
    """Returns the rows with a column of the steps that live from a plan before the last one, if an arm looks ahead."""
    if not any(arm["mode"] == "lookahead" for arm in arms.values()):
        return rows
    shares = [f"{100 * arm['plan_rate']:.1f} %" if arm["mode"] == "lookahead" else "-" for arm in arms.values()]
    cells = ["", "from a", "plan", *shares]
    return [[*row[:-1], cell, row[-1]] for row, cell in zip(rows, cells, strict=True)]


def _rows(arms: dict[str, dict[str, Any]]) -> list[list[str]]:
    """Returns the header's rows, then one row of text per summary of an arm."""
    return _with_plans([*map(list, _HEADERS), *([name, *_cells(arm)] for name, arm in arms.items())], arms)


def _cells(arm: dict[str, Any]) -> list[str]:
    low, high = arm["eval_violation_rate_ci95"]
    trained = arm["train_steps"] > 0
    return [
        f"{arm['train_violation_steps']:,}" if trained else "-",
        _overridden(arm, "train_intervention_rate") if trained else "-",
        f"{arm['eval_violating_episodes']:,} [{100 * low:.1f}, {100 * high:.1f} %]",
        f"{arm['eval_violation_steps']:,}",
        f"{arm['eval_episodes_outside_set']:,}",
        _overridden(arm, "intervention_rate"),
        _return_text(arm),
    ]


def _overridden(arm: dict[str, Any], key: str) -> str:
    """Returns a rate of interventions; in brackets what a monitor would have done."""
    text = f"{100 * arm[key]:.1f} %"
    return {"monitor": f"({text})", None: "-"}.get(arm["mode"], text)


def _return_text(arm: dict[str, Any]) -> str:
    """Returns mean and half-width of Student's interval, which is symmetric."""
    interval = arm["eval_return_ci95"]
    mean = arm["eval_return_mean"]
    if interval is None:
        return f"{mean:z.{decimals_of(mean)}f} [n/a]"
    half = 0.5 * (interval[1] - interval[0])
    decimals = decimals_of(mean, half)
    return f"{mean:z.{decimals}f} +-{half:.{decimals}f}"


def decimals_of(*numbers: float) -> int:
    """Returns how many decimals to print of numbers that belong together: one, more if the largest is below one."""
    largest = max(map(abs, numbers))
    if largest >= 1.0 or largest == 0.0:
        return 1
    return min(1 - floor(log10(largest)), _MOST_DECIMALS)


def sweep_table(cells: list[dict[str, Any]]) -> str:
    """Returns a row per point of the grid and arm, below a line that says what all points have in common.

    Args:
        cells: The points with the summaries of their arms, as in summary.json.
    """
    swept = [side for side in _SIDES if len({cell[side] for cell in cells}) > 1]
    fixed = [side for side in _SIDES if side not in swept and (side != "downlink_loss" or cells[0][side] is not None)]
    common = ", ".join(f"{_name(side)} {_side_text(side, cells[0][side])}" for side in fixed)
    rows = [list(line) for line in zip(*(_SIDES[side] for side in swept), *_OUTCOMES, strict=True)]
    for cell in cells:
        point = [_side_text(side, cell[side]) for side in swept]
        rows += [[*point, name, *_outcome(arm)] for name, arm in cell["arms"].items()]
    table = text_table(rows, rules=(2,), left_columns=0)
    return f"in all rows: {common}\n\n{table}" if common else table


def _name(side: str) -> str:
    first, second = _SIDES[side]
    return f"{first.removesuffix('-')}{'' if first.endswith('-') else ' '}{second}".strip()


def _side_text(side: str, value: float | None) -> str:
    """Returns what a point fixes as text; without a value it is the environment's own."""
    if value is None:
        return "own"
    return "none" if side == "burst_length" and not value else f"{value:g}"


def _outcome(arm: dict[str, Any]) -> list[str]:
    return [
        f"{arm['eval_violating_episodes']:,} of {arm['eval_episodes']:,}",
        f"{arm['train_violation_steps']:,} of {arm['train_steps']:,}",
        "-" if arm["mode"] is None else f"{100 * arm['intervention_rate']:.1f} %",
        f"{arm['eval_return_mean']:z.1f}",
    ]
