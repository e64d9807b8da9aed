"""The figures of the benchmark, from the numbers that its page shows; the page says what they are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from experiments.figures import STYLE, ArmStyle, CaptionedFigure, arm_styles, label, legend_below, thousands
from experiments.runs.loops import AS_TRAINED

ATTACKED = "attacked"
# What the figures compare; regulators stand below a line.
_VIOLATING = ("unshielded", "trusting:20", "shielded", "lqr", "mpc:20", "lqr+trusting:20", "lqr:observer+shielded")
_RETURNS = ("unshielded", "shielded", "shielded, disturbance", "lqr", "lqr:observer+shielded")
_TRAINED = ("unshielded", "trusting:20", "shielded")
# Width of a panel, height of a row and of a panel of curves, what titles take [inches].
_PANEL, _ROW, _CURVES, _TITLES = 2.9, 0.27, 2.2, 0.9

Blocks = Mapping[str, dict[str, Any]]


def suite_figures(found: dict[str, Any]) -> dict[str, bytes]:
    """Returns the PNG file of every figure by name."""
    tasks: dict[str, Blocks] = found["tasks"]
    network = {task: blocks for task, blocks in tasks.items() if "trusting:20" in blocks["0"]}
    figures = {"return": _rows(tasks, _RETURNS, "mean return as trained", _draw_returns)}
    if network:
        figures["violations"] = _rows(network, _VIOLATING, "violating under attack [%]", _draw_attacked)
        figures["training"] = _curves(network)
    return {name: figure.png for name, figure in figures.items()}


def _rows(
    tasks: Mapping[str, Blocks],
    names: Sequence[str],
    quantity: str,
    draw: Callable[[Axes, ArmStyle, list[dict[str, Any]], int], None],
) -> CaptionedFigure:
    """Returns a quantity of some rows, a panel per task and a marker per block."""
    styles, columns = arm_styles(list(names)), min(len(tasks), 3)
    lines = -(-len(tasks) // columns)
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((1.7 + _PANEL * columns, lines * (_TITLES + _ROW * len(names))))
        axes = figure.subplots(lines, columns, squeeze=False, sharey=True)
        for axis in axes.flat[len(tasks) :]:
            axis.set_visible(False)
        for axis, (task, blocks) in zip(axes.flat, tasks.items(), strict=False):
            for height, name in zip(range(len(names), 0, -1), names, strict=True):
                if own := [each[name] for each in blocks.values() if name in each]:
                    draw(axis, styles[name], own, height)
                else:
                    place = {"transform": axis.get_yaxis_transform(), "ha": "center", "va": "center"}
                    axis.text(0.5, height, "not trained", color="#555555", backgroundcolor="white", **place)
            axis.axhline(sum(name.startswith(("lqr", "mpc")) for name in names) + 0.5, color="#555555", lw=0.8)
            label(axis, quantity, "", task)
        axes[0, 0].set_yticks(range(len(names), 0, -1), names)
        axes[0, 0].set_ylim(0.4, len(names) + 0.6)
    return figure


def _draw_returns(axis: Axes, style: ArmStyle, blocks: list[dict[str, Any]], height: int) -> None:
    runs = [np.array(each["scenarios"][AS_TRAINED]["return"]) for each in blocks]
    _draw(axis, style, runs, height)
    axis.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    axis.xaxis.set_major_formatter(thousands)


def _draw_attacked(axis: Axes, style: ArmStyle, blocks: list[dict[str, Any]], height: int) -> None:
    _draw(axis, style, [100.0 * np.array(each["scenarios"][ATTACKED]["violating"]) for each in blocks], height)
    axis.set_xlim(-5.0, 105.0)


def _draw(axis: Axes, style: ArmStyle, blocks: list[np.ndarray], height: int) -> None:
    """Draws the means of blocks above each other, and small the runs of all."""
    for runs, shift in zip(blocks, (0.14, -0.14) if len(blocks) > 1 else (0.0,), strict=False):
        axis.plot(runs, [height + shift] * len(runs), "o", ms=2.5, color=style.color, alpha=0.35, mew=0.0)
        axis.plot(np.mean(runs), height + shift, "o", ms=6.0, mfc=style.color, mec="white", mew=0.6, zorder=4)


def _curves(tasks: Mapping[str, Blocks]) -> CaptionedFigure:
    """Returns violating steps and return of agents while they learn: medians, and bands that hold most runs."""
    styles = arm_styles(list(_TRAINED))
    titles = {"violating_steps": "violating steps so far", "return": "return of recent episodes"}
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((1.0 + _PANEL * len(tasks), 0.8 + _CURVES * len(titles)))
        axes = figure.subplots(len(titles), len(tasks), squeeze=False, sharex=True)
        for (column, title), line in zip(titles.items(), axes, strict=True):
            for axis, (task, blocks) in zip(line, tasks.items(), strict=True):
                for name in _TRAINED:
                    own = [each[name]["curve"] for each in blocks.values() if name in each]
                    steps = np.array(own[0]["steps"][0]) / 1e3
                    low, middle, high = np.quantile(np.concatenate([e[column] for e in own]), (0.1, 0.5, 0.9), axis=0)
                    axis.plot(steps, middle, color=styles[name].color, lw=1.6)
                    axis.fill_between(steps, low, high, color=styles[name].color, alpha=0.18, lw=0.0)
                last = column == "return"
                label(axis, "thousand steps" if last else "", title if axis is line[0] else "", "" if last else task)
                axis.yaxis.set_major_formatter(thousands)
        legend_below(figure, {name: Line2D([], [], color=styles[name].color, lw=1.6) for name in _TRAINED})
    return figure
