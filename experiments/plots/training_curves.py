"""Return, violations and interventions while agents learn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from experiments.plots.figure_style import STYLE, ArmStyle, CaptionedFigure, label, legend_below, thousands
from experiments.runs.arms import Arm, ResultsByArm
from experiments.runs.training_run import RunResult

# Curves of fewer points show each point.
_FEW_POINTS = 5
# The rate of interventions is averaged over this many steps, an episode of 200 in each of 64 environments: it rises and
# falls with the episodes, which start together.
_RATE_WINDOW = 64 * 200


def training_figure(arms: ResultsByArm) -> CaptionedFigure:
    """Returns return, violating steps so far and intervention rate against training steps, bands over runs.

    Without an arm that watches for unsafe actions there is no third panel.
    """
    watching = [name for name in arms if Arm.of(name).mode is not None]
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((11.0, 3.9), _caption(arms))
        axes = figure.subplots(1, 3 if watching else 2)
        for name, results in arms.items():
            steps = _common_steps(results)
            style = ArmStyle.of(name)
            _draw(axes[0], steps, _on(steps, results, "episode_return"), style)
            violations = _on(steps, results, "violation_steps")
            # Before the first step nothing has happened: true, and a curve even where the history is one point.
            _draw(axes[1], np.array([0, *steps]), np.pad(violations, ((0, 0), (1, 0))), style)
            if name in watching:
                _draw(axes[2], steps, 100.0 * _rates(steps, _on(steps, results, "interventions")), style)
        label(axes[0], "training steps", "mean return of recent episodes", "Return")
        label(axes[1], "training steps", "violating steps so far", "Violations of the true state")
        if watching:
            label(
                axes[2],
                "training steps",
                "actions overridden [%]",
                "Interventions" + (" (monitor's: hypothetical)" if "monitor" in arms else ""),
            )
        last = max((point.steps for runs in arms.values() for run in runs for point in run.history), default=1)
        for axis in axes:
            _scale(axis, last, from_zero=axis is not axes[0])
        legend_below(figure, _handles(arms))
        return figure


def _caption(arms: ResultsByArm) -> str:
    """Returns the caption: what the lines and bands are."""
    runs = max(len(results) for results in arms.values())
    band = (
        f"Lines are means over {runs} runs per arm, bands reach from the lowest to the highest run."
        if runs > 1
        else "One run per arm, so there is no band."
    )
    text = f"Training. {band} The return begins where every run has finished an episode."
    if any(Arm.of(name).mode is not None for name in arms):
        text += f" Interventions are rates over the last {_RATE_WINDOW:,} steps (over all, before there are as many)."
    if "monitor" in arms:
        text += " The monitor's are what the shield would have overridden; its agent is the unshielded one."
    penalized = [name for name in arms if Arm.of(name).penalizes_interventions or Arm.of(name).penalizes_violations]
    if penalized:
        text += f" The return in training contains the penalties that {' and '.join(penalized)} get."
    return text


def _common_steps(results: Sequence[RunResult]) -> np.ndarray:
    """Returns steps that all runs of an arm have reached, shape (points,): those of the run with the shortest history.

    Runs of one arm may note their totals at different steps; others are interpolated there.
    """
    steps = [np.array([point.steps for point in result.history], dtype=float) for result in results]
    last = min((run[-1] for run in steps if len(run)), default=0.0)
    shortest = min(steps, key=len)
    return shortest[shortest <= last]


def _rates(steps: np.ndarray, totals: np.ndarray) -> np.ndarray:
    """Returns events per step over the last `_RATE_WINDOW` steps, shape (runs, points).

    Args:
        steps: Shape (points,).
        totals: Events so far, shape (runs, points).
    """
    past = np.maximum(steps - _RATE_WINDOW, 0.0)
    before = np.array([np.interp(past, [0.0, *steps], [0.0, *row]) for row in totals])
    return (totals - before) / (steps - past)


def _on(steps: np.ndarray, results: Sequence[RunResult], name: str) -> np.ndarray:
    """Returns one quantity of the histories at some steps, shape (runs, points)."""
    rows = []
    for result in results:
        own = [point.steps for point in result.history]
        values = [float(getattr(point, name)) for point in result.history]
        rows.append(np.interp(steps, own, values) if own else np.full(len(steps), np.nan))
    return np.array(rows)


def _draw(axis: Axes, steps: np.ndarray, values: np.ndarray, style: ArmStyle) -> None:
    """Draws the mean of the runs, shape (runs, points), and a band from the lowest to the highest."""
    if len(values) > 1:
        low, high = values.min(axis=0), values.max(axis=0)
        if len(steps) < _FEW_POINTS:
            axis.vlines(steps, low, high, color=style.color, lw=1.5, alpha=0.6)
        axis.fill_between(steps, low, high, color=style.color, alpha=0.16, lw=0.0)
    points: dict[str, Any] = style.points if len(steps) < _FEW_POINTS else {}
    axis.plot(steps, values.mean(axis=0), lw=1.9, **style.line, **points)


def _scale(axis: Axes, last: float, from_zero: bool) -> None:
    axis.set_xlim(0.0, 1.04 * last)
    if from_zero:
        # A curve at zero keeps its width above the axis.
        high = axis.dataLim.y1 if axis.dataLim.y1 > 0.0 else 1.0
        axis.set_ylim(-0.02 * high, 1.06 * high)
    elif not np.isfinite(axis.dataLim.y1):
        axis.set_yticks([])
        axis.text(0.5, 0.5, "no episode was finished", ha="center", color="#555555", transform=axis.transAxes)
    for side in (axis.xaxis, axis.yaxis):
        if side is axis.xaxis or np.isfinite(axis.dataLim.y1):
            side.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        side.set_major_formatter(thousands)


def _handles(arms: ResultsByArm) -> dict[str, Artist]:
    points = any(len(_common_steps(results)) < _FEW_POINTS for results in arms.values())
    handles: dict[str, Artist] = {name: ArmStyle.of(name).handle(points=points) for name in arms}
    if any(len(results) > 1 for results in arms.values()):
        handles["lowest to highest run"] = Patch(color="#555555", alpha=0.2, lw=0.0)
    return handles
