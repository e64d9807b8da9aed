"""The figures of the study, from the numbers that its pages show; the pages say what they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from experiments.plots.figure_style import STYLE, ArmStyle, CaptionedFigure, arm_styles, label, thousands
from experiments.runs.loops import AS_TRAINED

ATTACKED = "attacked"
# Smaller margins are not drawn: with them arms do nearly what they do with none.
_LEAST_MARGIN = 20
# Width of the panels of an environment, height of a row, what names and axes take, and the least height of all rows
# [inches].
_PANELS, _ROW, _MARGINS = 3.6, 0.2, (1.7, 0.9)
_LEAST_HEIGHT = 1.8
# Runs lie so far below their mean [rows].
_LANE = 0.3
# Size of the mean of an arm [points]; rows have names, so that markers need not tell arms apart.
_MEAN_SIZE = 7.0


def study_figures(summary: dict[str, Any]) -> dict[str, bytes]:
    """Returns the PNG file of every figure by name."""
    figures = {"return": return_figure(summary)}
    if any(_trained(env) for env in summary["environments"].values()):
        figures["runs"] = _by_run_figure(summary, "violating under attack [%]", _draw_attacked)
        figures["training"] = _by_run_figure(summary, "violating training steps", _draw_training)
    return {name: figure.png for name, figure in figures.items()}


def return_figure(summary: dict[str, Any]) -> CaptionedFigure:
    """Returns violating episodes under attack and the mean return as trained, two panels per environment."""
    environments = summary["environments"]
    names = list(dict.fromkeys(name for env in environments.values() for name in env["arms"] if _is_drawn(name)))
    styles = arm_styles(names)
    figure, axes = _figure(len(environments), len(names), panels=2)
    with matplotlib.rc_context(STYLE):
        for (left, right), (title, env) in zip(axes, environments.items(), strict=True):
            for name in env["arms"].keys() & names:
                scenarios, height = env["arms"][name]["scenarios"], len(names) - names.index(name)
                style, own, attacked = styles[name], scenarios[AS_TRAINED], scenarios[ATTACKED]
                _draw_interval(left, style, attacked["rate_ci95"], height, 100.0)
                _draw_mean(left, style, 100.0 * attacked["rate"], height)
                _draw_interval(right, style, own["return_ci95"], height)
                _draw_mean(right, style, own["return"], height)
            last_trained = max((names.index(name) for name in _trained(env)), default=-1)
            for axis in (left, right):
                axis.axhline(len(names) - last_trained - 0.5, color="#555555", lw=0.8)
            label(left, "violating [%]", "")
            left.set_title(title, loc="left")
            label(right, "return as trained", "")
            left.set_xlim(-8.0, 108.0)
            right.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
            right.xaxis.set_major_formatter(thousands)
        _name_rows(axes[0][0], names)
    return figure


def _by_run_figure(
    summary: dict[str, Any], quantity: str, draw: Callable[[Axes, ArmStyle, dict[str, Any], int], None]
) -> CaptionedFigure:
    """Returns something of every trained run, a panel per environment."""
    environments = summary["environments"]
    names = list(dict.fromkeys(name for env in environments.values() for name in _trained(env)))
    styles = arm_styles(names)
    figure, axes = _figure(len(environments), len(names))
    with matplotlib.rc_context(STYLE):
        for (axis,), (title, env) in zip(axes, environments.items(), strict=True):
            for name in _trained(env):
                draw(axis, styles[name], env["arms"][name], len(names) - names.index(name))
            label(axis, quantity, "", title)
        _name_rows(axes[0][0], names)
    return figure


def _draw_attacked(axis: Axes, style: ArmStyle, arm: dict[str, Any], height: int) -> None:
    attacked = arm["scenarios"][ATTACKED]
    _draw_interval(axis, style, attacked["rate_ci95"], height, 100.0)
    _draw_runs(axis, style, [100.0 * rate for rate in attacked["rate_by_run"]], height)
    axis.set_xlim(-5.0, 105.0)


def _draw_training(axis: Axes, style: ArmStyle, arm: dict[str, Any], height: int) -> None:
    _draw_runs(axis, style, arm["train_violation_steps_by_run"], height)
    axis.set_xscale("symlog", linthresh=1.0)
    axis.set_xlim(-0.3, max(1.0, axis.dataLim.x1) * 2.0)


def _figure(environments: int, rows: int, panels: int = 1) -> tuple[CaptionedFigure, list[list[Axes]]]:
    """Returns a figure, and the panels of each environment, which share named rows."""
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((_MARGINS[0] + _PANELS * environments, _MARGINS[1] + max(_ROW * rows, _LEAST_HEIGHT)))
        axes = figure.subplots(1, panels * environments, squeeze=False, sharey=True)[0]
    return figure, [list(axes[i : i + panels]) for i in range(0, len(axes), panels)]


def _name_rows(axis: Axes, names: list[str]) -> None:
    axis.set_yticks(range(len(names), 0, -1), names)
    axis.set_ylim(0.4, len(names) + 0.6)


def _is_drawn(name: str) -> bool:
    """Returns whether an arm has no margin, or one that is large enough."""
    base, _, margin = name.rpartition(":")
    return not margin.isdigit() or base.startswith("penalized") or int(margin) >= _LEAST_MARGIN  # that is a price


def _trained(env: dict[str, Any]) -> list[str]:
    return [name for name in env["trained"] if env["arms"][name]["train_steps"]]


def _draw_runs(axis: Axes, style: ArmStyle, values: list[float], height: int) -> None:
    axis.plot(values, [height - _LANE] * len(values), "o", ms=4.0, mfc=style.color, mec="white", mew=0.7, zorder=4)
    _draw_mean(axis, style, float(np.mean(values)), height)


def _draw_mean(axis: Axes, style: ArmStyle, value: float, height: int) -> None:
    points = style.points | {"marker": "o", "ms": _MEAN_SIZE, "mfc": style.color}
    axis.plot(value, height, ls="none", zorder=3, **points)


def _draw_interval(axis: Axes, style: ArmStyle, ends: list[float] | None, height: int, scale: float = 1.0) -> None:
    if ends is not None:
        axis.plot([scale * end for end in ends], [height] * 2, "-", color=style.color, lw=1.3)
