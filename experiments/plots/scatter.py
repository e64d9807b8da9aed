"""Safety cost against return of each arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from experiments.plots.arm_style import ArmStyle
from experiments.plots.figure_style import STYLE, CaptionedFigure, label, legend_below, thousands
from experiments.runs.arms import ResultsByArm
from experiments.runs.training_run import RunResult

# Marker sizes of the first and of the last arm [points]: where arms coincide, the lower ones are visible.
_SIZES = (12.0, 7.5)


def scatter_figure(summary: dict[str, dict[str, Any]], arms: ResultsByArm) -> CaptionedFigure:
    """Returns mean return against violating steps per episode and against violating episodes.

    Args:
        summary: Summary of each arm.
        arms: Results of each arm.
    """
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((11.0, 4.4), _caption(arms))
        steps, episodes = figure.subplots(1, 2, sharey=True)
        sizes = np.linspace(*_SIZES, len(arms))
        styles = {name: replace(ArmStyle.of(name), size=float(size)) for name, size in zip(arms, sizes, strict=True)}
        for name, results in arms.items():
            arm, style = summary[name], styles[name]
            per_episode = [_mean(result, "violation_steps") for result in results]
            rates = [100.0 * float(np.mean([e.violation_steps > 0 for e in result.episodes])) for result in results]
            _draw_arm(steps, style, arm, per_episode, float(np.mean(per_episode)), None)
            bounds = [100.0 * bound for bound in arm["eval_violation_rate_ci95"]]
            _draw_arm(episodes, style, arm, rates, 100.0 * arm["eval_violation_rate"], bounds)
        label(steps, "violating steps per evaluation episode", "mean return per episode")
        label(episodes, "violating evaluation episodes [%]", "")
        for axis in (steps, episodes):
            _scale(axis)
        legend_below(figure, {name: style.handle(line=False, points=True) for name, style in styles.items()})
        return figure


def _caption(arms: ResultsByArm) -> str:
    """Returns the caption: what points and bars are."""
    runs = max(len(results) for results in arms.values())
    text = "Cost and return in evaluation, better to the upper left."
    if runs > 1:
        text += (
            f" Small dots are runs, markers the mean of {runs} of them; vertical bars are Student's 95 % interval of"
            " the mean return over runs,"
        )
    else:
        text += " A marker is one run, so the return has no interval;"
    text += (
        " horizontal bars on the right Clopper and Pearson's 95 % interval of violating episodes given the trained"
        " agents. Markers differ in size only to show where they coincide. Violations are those of the true state,"
        " returns the environment's own, without penalties."
    )
    lengths = {episode.steps for results in arms.values() for result in results for episode in result.episodes}
    if len(lengths) > 1:
        text += " Episodes that end at a violation are shorter: their returns sum fewer steps."
    return text


def _draw_arm(
    axis: Axes,
    style: ArmStyle,
    arm: dict[str, Any],
    costs: Sequence[float],
    cost: float,
    bounds: Sequence[float] | None,
) -> None:
    """Draws an arm's runs and mean, with the intervals that there are.

    Args:
        axis: Axis to draw on.
        style: Style of the arm.
        arm: Summary of the arm.
        costs: Cost of each run.
        cost: Cost of all runs together.
        bounds: Confidence interval of the cost.
    """
    mean = arm["eval_return_mean"]
    if len(costs) > 1:
        axis.plot(costs, arm["eval_return_by_run"], "o", ms=4.5, mfc=style.color, mec="white", mew=0.6, zorder=2.5)
    if arm["eval_return_ci95"] is not None:
        axis.plot([cost, cost], arm["eval_return_ci95"], "-_", color=style.color, lw=1.3, ms=9.0, mew=1.3)
    if bounds is not None:
        axis.plot(bounds, [mean, mean], "-|", color=style.color, lw=1.3, ms=9.0, mew=1.3)
    axis.plot(cost, mean, ls="none", **style.points, zorder=3)


def _scale(axis: Axes) -> None:
    """Lets the axis of costs begin at zero, with space for markers there."""
    high = axis.dataLim.x1 if axis.dataLim.x1 > 0.0 else 1.0
    axis.set_xlim(-0.04 * high, 1.06 * high)
    axis.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    axis.xaxis.set_major_formatter(thousands)
    axis.yaxis.set_major_formatter(thousands)


def _mean(result: RunResult, name: str) -> float:
    return float(np.mean([getattr(episode, name) for episode in result.episodes]))
