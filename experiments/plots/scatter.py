"""Violating episodes against return of each arm."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from experiments.plots.figure_style import STYLE, ArmStyle, CaptionedFigure, label, legend_below, thousands
from experiments.runs.arms import ResultsByArm

# Marker sizes of the first and of the last arm [points]: where arms coincide, the lower ones are visible.
_SIZES = (12.0, 7.5)


def scatter_figure(summary: dict[str, dict[str, Any]], arms: ResultsByArm) -> CaptionedFigure:
    """Returns mean return against violating episodes.

    Args:
        summary: Summary of each arm.
        arms: Results of each arm.
    """
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((7.5, 4.4), _caption(arms))
        axis = figure.subplots()
        sizes = np.linspace(*_SIZES, len(arms))
        styles = {name: replace(ArmStyle.of(name), size=float(size)) for name, size in zip(arms, sizes, strict=True)}
        for name, results in arms.items():
            rates = [100.0 * float(np.mean([e.violation_steps > 0 for e in result.episodes])) for result in results]
            _draw_arm(axis, styles[name], summary[name], rates)
        label(axis, "violating evaluation episodes [%]", "mean return per episode")
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
        " horizontal bars Clopper and Pearson's 95 % interval of violating episodes given the trained"
        " agents. Markers differ in size only to show where they coincide. Violations are those of the true state,"
        " returns the environment's own, without penalties."
    )
    lengths = {episode.steps for results in arms.values() for result in results for episode in result.episodes}
    if len(lengths) > 1:
        text += " Episodes that end at a violation are shorter: their returns sum fewer steps."
    return text


def _draw_arm(axis: Axes, style: ArmStyle, arm: dict[str, Any], rates: list[float]) -> None:
    """Draws an arm's runs and mean, with the intervals that there are.

    Args:
        axis: Axis to draw on.
        style: Style of the arm.
        arm: Summary of the arm.
        rates: Violating episodes of each run [%].
    """
    mean, rate = arm["eval_return_mean"], 100.0 * arm["eval_violation_rate"]
    if len(rates) > 1:
        axis.plot(rates, arm["eval_return_by_run"], "o", ms=4.5, mfc=style.color, mec="white", mew=0.6, zorder=2.5)
    if arm["eval_return_ci95"] is not None:
        axis.plot([rate, rate], arm["eval_return_ci95"], "-_", color=style.color, lw=1.3, ms=9.0, mew=1.3)
    bounds = [100.0 * bound for bound in arm["eval_violation_rate_ci95"]]
    axis.plot(bounds, [mean, mean], "-|", color=style.color, lw=1.3, ms=9.0, mew=1.3)
    axis.plot(rate, mean, ls="none", **style.points, zorder=3)


def _scale(axis: Axes) -> None:
    """Lets the axis of costs begin at zero, with space for markers there."""
    high = axis.dataLim.x1 if axis.dataLim.x1 > 0.0 else 1.0
    axis.set_xlim(-0.04 * high, 1.06 * high)
    axis.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    axis.xaxis.set_major_formatter(thousands)
    axis.yaxis.set_major_formatter(thousands)
