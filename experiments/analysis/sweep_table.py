"""The table of `ncs sweep` on a terminal."""

from __future__ import annotations

from typing import Any

from experiments.analysis.terminal_text import text_table
from experiments.runs.arms import Arm

# Two lines of the header of what a point of the grid fixes, by its key.
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
        rows += [[*point, name, *_outcome(name, arm)] for name, arm in cell["arms"].items()]
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


def _outcome(name: str, arm: dict[str, Any]) -> list[str]:
    return [
        f"{arm['eval_violating_episodes']:,} of {arm['eval_episodes']:,}",
        f"{arm['train_violation_steps']:,} of {arm['train_steps']:,}",
        "-" if Arm.of(name).mode is None else f"{100 * arm['intervention_rate']:.1f} %",
        f"{arm['eval_return_mean']:z.1f}",
    ]
