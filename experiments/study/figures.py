"""The figures of a study, from the numbers that pages show."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from experiments.plots.figure_style import (
    STYLE,
    ArmStyle,
    CaptionedFigure,
    draw_estimate,
    label,
    legend_below,
    thousands,
)
from experiments.runs.loops import AS_TRAINED
from experiments.study.summary import ATTACKED

# Smaller margins are not drawn: with them arms do nearly what they do with none, and their points lie on one another.
_LEAST_MARGIN = 20


def study_figures(summary: dict[str, Any]) -> dict[str, tuple[str, bytes]]:
    """Returns caption and PNG file of every figure by name, of what `study_summary` returns."""
    figures = {"return": return_figure(summary)}
    if any(_trained(env) for env in summary["environments"].values()):
        figures |= {"runs": runs_figure(summary), "training": training_figure(summary)}
    return {name: (figure.caption, figure.png) for name, figure in figures.items()}


def return_figure(summary: dict[str, Any]) -> CaptionedFigure:
    """Returns the mean return as trained against violating episodes under attack, a panel per environment."""
    environments = summary["environments"]
    with matplotlib.rc_context(STYLE):
        caption = (
            "Violating episodes under attack and return as trained, better to the upper left. Bars are 95 % intervals "
            f"over runs and episodes. Small numbers are margins in percent; those below {_LEAST_MARGIN} are left out."
        )
        figure = CaptionedFigure((4.1 * len(environments), 5.0), caption)
        handles = {}
        axes = figure.subplots(1, len(environments), squeeze=False)[0]
        for axis, (name, env) in zip(axes, environments.items(), strict=True):
            for arm_name, arm in env["arms"].items():
                base, _, margin = arm_name.rpartition(":")
                has_margin = margin.isdigit() and not base.startswith("penalized")  # whose number is a price
                if has_margin and int(margin) < _LEAST_MARGIN:
                    continue
                known, style = base if has_margin else arm_name, ArmStyle.of(arm_name)
                _draw_point(axis, style, arm["scenarios"], margin if has_margin else "")
                handles.setdefault(known, style.handle(line=False, points=True))
            label(axis, "violating under attack [%]", "mean return as trained" if axis is axes[0] else "", name)
            axis.set_xlim(-5.0, 105.0)
            axis.yaxis.set_major_formatter(thousands)
        legend_below(figure, handles)
        return figure


def runs_figure(summary: dict[str, Any]) -> CaptionedFigure:
    """Returns the violating episodes of every trained run under attack, a panel per environment."""
    caption = (
        "Violating episodes under attack, by training run. Small dots are runs, markers their mean, bars 95 % "
        "intervals over runs and episodes."
    )

    def draw(axis: Axes, style: ArmStyle, arm: dict[str, Any], height: int) -> None:
        attacked = arm["scenarios"].get(ATTACKED, arm["scenarios"][AS_TRAINED])
        if attacked["rate_ci95"] is not None:
            axis.plot([100.0 * end for end in attacked["rate_ci95"]], [height] * 2, "-", color=style.color, lw=1.0)
        _draw_runs(axis, style, [100.0 * rate for rate in attacked["rate_by_run"]], height)
        axis.set_xlim(-5.0, 105.0)

    return _by_run_figure(summary, caption, "violating under attack [%]", draw)


def training_figure(summary: dict[str, Any]) -> CaptionedFigure:
    """Returns the violating steps of every training run, a panel per environment."""
    caption = (
        "Violating steps while the agents learned, on a scale that is linear up to 1 and logarithmic beyond. Small "
        "dots are runs, markers their mean. These violations do not appear in the evaluation."
    )

    def draw(axis: Axes, style: ArmStyle, arm: dict[str, Any], height: int) -> None:
        _draw_runs(axis, style, arm["train_violation_steps_by_run"], height)
        axis.set_xscale("symlog", linthresh=1.0)
        axis.set_xlim(-0.3, max(1.0, axis.dataLim.x1) * 2.0)

    return _by_run_figure(summary, caption, "violating training steps", draw)


def _by_run_figure(summary: dict[str, Any], caption: str, quantity: str, draw: Any) -> CaptionedFigure:
    environments = summary["environments"]
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((4.1 * len(environments), 3.6), caption)
        axes = figure.subplots(1, len(environments), squeeze=False, sharey=True)[0]
        names = list(dict.fromkeys(name for env in environments.values() for name in _trained(env)))
        for axis, (title, env) in zip(axes, environments.items(), strict=True):
            for name in _trained(env):
                draw(axis, ArmStyle.of(name), env["arms"][name], len(names) - names.index(name))
            axis.set_yticks(range(len(names), 0, -1), names)
            label(axis, quantity, "", title)
        return figure


def _trained(env: dict[str, Any]) -> list[str]:
    return [name for name in env["trained"] if env["arms"][name]["train_steps"]]


def _draw_runs(axis: Axes, style: ArmStyle, values: list[float], height: int) -> None:
    axis.plot(values, [height] * len(values), "o", ms=4.0, mfc=style.color, mec="white", mew=0.5)
    axis.plot(np.mean(values), height, ls="none", **style.points)


def _draw_point(axis: Axes, style: ArmStyle, scenarios: dict[str, Any], margin: str) -> None:
    own, attacked = scenarios[AS_TRAINED], scenarios.get(ATTACKED, scenarios[AS_TRAINED])
    draw_estimate(axis, style, attacked["rate"], attacked["rate_ci95"], own["return"], own["return_ci95"])
    if margin:
        point = (100.0 * attacked["rate"], own["return"])
        axis.annotate(margin, point, (4.0, 4.0), textcoords="offset points", size=6.5)
