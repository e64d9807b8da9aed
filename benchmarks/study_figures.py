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
# Width of a panel, height of a row, what names and axes take, and the least height of all rows [inches].
_PANELS, _ROW, _MARGINS = 3.6, 0.2, (1.7, 0.9)
_LEAST_HEIGHT = 1.8
# Runs lie so far below their mean [rows].
_LANE = 0.3
# Size of the mean of an arm [points]; rows have names, so that markers need not tell arms apart.
_MEAN_SIZE = 7.0


def study_figures(summary: dict[str, Any]) -> dict[str, bytes]:
    """Returns the PNG file of every figure by name."""
    figures = {
        "violations": _figure(summary, _drawn, "violating under attack [%]", _draw_attacked),
        "return": _figure(summary, _drawn, "mean return as trained", _draw_return),
    }
    if any(_trained(env) for env in summary["environments"].values()):
        figures["training"] = _figure(summary, _trained, "violating training steps", _draw_training)
    return {name: figure.png for name, figure in figures.items()}


def _figure(
    summary: dict[str, Any],
    names_of: Callable[[dict[str, Any]], list[str]],
    quantity: str,
    draw: Callable[[Axes, ArmStyle, dict[str, Any], int], None],
) -> CaptionedFigure:
    """Returns a quantity of some arms, a row each; a panel per environment, trained arms above a line."""
    environments = summary["environments"]
    names = list(dict.fromkeys(name for env in environments.values() for name in names_of(env)))
    styles = arm_styles(names)
    with matplotlib.rc_context(STYLE):
        height = _MARGINS[1] + max(_ROW * len(names), _LEAST_HEIGHT)
        figure = CaptionedFigure((_MARGINS[0] + _PANELS * len(environments), height))
        axes = figure.subplots(1, len(environments), squeeze=False, sharey=True)[0]
        for axis, (title, env) in zip(axes, environments.items(), strict=True):
            for name in names_of(env):
                draw(axis, styles[name], env["arms"][name], len(names) - names.index(name))
            last_trained = max((names.index(name) for name in _trained(env)), default=-1)
            if last_trained + 1 < len(names):
                axis.axhline(len(names) - last_trained - 0.5, color="#555555", lw=0.8)
            label(axis, quantity, "", title)
        axes[0].set_yticks(range(len(names), 0, -1), names)
        axes[0].set_ylim(0.4, len(names) + 0.6)
    return figure


def _draw_return(axis: Axes, style: ArmStyle, arm: dict[str, Any], height: int) -> None:
    own = arm["scenarios"][AS_TRAINED]
    _draw_interval(axis, style, own["return_ci95"], height)
    _draw_mean(axis, style, own["return"], height)
    axis.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    axis.xaxis.set_major_formatter(thousands)


def _draw_attacked(axis: Axes, style: ArmStyle, arm: dict[str, Any], height: int) -> None:
    attacked = arm["scenarios"][ATTACKED]
    _draw_interval(axis, style, attacked["rate_ci95"], height, 100.0)
    _draw_mean(axis, style, 100.0 * attacked["rate"], height)
    axis.set_xlim(-5.0, 105.0)


def _draw_training(axis: Axes, style: ArmStyle, arm: dict[str, Any], height: int) -> None:
    _draw_runs(axis, style, arm["train_violation_steps_by_run"], height)
    axis.set_xscale("symlog", linthresh=1.0)
    axis.set_xlim(-0.3, max(1.0, axis.dataLim.x1) * 2.0)


def _drawn(env: dict[str, Any]) -> list[str]:
    return [name for name in env["arms"] if _is_drawn(name)]


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
