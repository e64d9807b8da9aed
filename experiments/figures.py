"""Figures: the look that all of them share, then those of a comparison."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from experiments.runs.arms import Arm, ResultsByArm
from experiments.runs.loops import AS_TRAINED
from experiments.runs.training_run import RunResult

# Keys of matplotlib's settings are a type of their own, which plain text is not.
STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.titlesize": 10.5,
    "grid.color": "#e4e4e4",
    "legend.frameon": False,
    "figure.dpi": 200,
}
# Mean width of a letter and of a handle in a legend [inches].
_LETTER, _HANDLE = 0.085, 0.6


class CaptionedFigure(Figure):
    """A figure of matplotlib of a size [inches], with a `caption`."""

    def __init__(self, size: tuple[float, float], caption: str = "") -> None:
        super().__init__(figsize=size, layout="constrained")
        self.caption = caption

    @property
    def png(self) -> bytes:
        """Content of the PNG file."""
        buffer = io.BytesIO()
        # Some settings are read only when a figure is drawn.
        with matplotlib.rc_context(STYLE):
            self.savefig(buffer, format="png", metadata={"Software": ""})
        return buffer.getvalue()


def label(axis: Axes, x: str, y: str, title: str = "") -> None:
    """Sets labels and title of an axis."""
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.set_title(title)


def legend_below(figure: Figure, handles: dict[str, Artist]) -> None:
    """Puts one legend below a figure, where it covers no data, in as many rows as it needs."""
    names, columns = list(handles), len(handles)

    def width() -> float:  # about how wide it is [inches]: one column after the other is filled
        return sum(_LETTER * max(map(len, part)) + _HANDLE for part in np.array_split(np.array(names), columns))

    while columns > 1 and width() > figure.get_figwidth():
        columns -= 1
    figure.legend(list(handles.values()), names, loc="outside lower center", ncols=columns)


def thousands(value: float, _: object = None) -> str:
    """Returns a tick's text with thousands separators and a true minus sign."""
    return f"{value:,.12g}".replace("-", "\N{MINUS SIGN}")


# Colors (after Okabe and Ito, which color-blind readers can distinguish) and markers (for print without color).
_LOOKS = {
    "#E69F00": "s",
    "#7F0000": "<",
    "#009E73": "P",
    "#CC79A7": "X",
    "#56B4E9": "v",
    "#117733": ">",
    "#DDCC77": "d",
    "#4D4D4D": "D",
    "#000080": "p",
    "#BBBBBB": "*",
}
# Those of the arms that most figures have.
_OWN = {"unshielded": ("#D55E00", "o"), "shielded": ("#0072B2", "^")}
_DASHES: tuple[Any, ...] = ("-", (0, (4.5, 1.6)), (0, (1.0, 1.3)))


@dataclass(frozen=True)
class ArmStyle:
    """Style of an arm, in matplotlib's words; the size of markers is in points."""

    color: str
    marker: str
    dashes: Any = "-"
    size: float = 8.0

    @property
    def line(self) -> dict[str, Any]:
        """Keyword arguments of matplotlib for lines."""
        return {"color": self.color, "ls": self.dashes}

    @property
    def points(self) -> dict[str, Any]:
        """Keyword arguments of matplotlib for markers; their fill is transparent."""
        own = {"marker": self.marker, "ms": self.size, "mec": self.color, "mew": 1.3}
        return own | {"mfc": to_rgba(self.color, 0.45)}

    def handle(self, *, line: bool = True, points: bool = False) -> Line2D:
        """Returns the arm's entry in a legend."""
        shape = self.line | {"lw": 2.0} if line else {"ls": "none"}
        return Line2D([], [], **shape, **(self.points if points else {}))


def arm_styles(names: Iterable[str]) -> dict[str, ArmStyle]:
    """Returns the styles of arms that are drawn together, which all differ for up to thirty arms."""
    looks = itertools.cycle(ArmStyle(*look, dashes) for dashes in _DASHES for look in _LOOKS.items())
    return {name: ArmStyle(*_OWN[name]) if name in _OWN else next(looks) for name in names}


# Marker sizes of the first and of the last arm [points]: where arms coincide, all are visible.
_SIZES = (12.0, 7.5)
# Panels of the scatter figure beside each other.
_PANELS = 3
# Curves of fewer points show each point.
_FEW_POINTS = 5
# The rate of interventions is averaged over this many steps, an episode of 200 in each of 64 environments: it rises and
# falls with the episodes, which start together.
RATE_WINDOW = 64 * 200


def comparison_figures(summary: dict[str, Any], results: ResultsByArm) -> dict[str, tuple[str, bytes]]:
    """Returns caption and PNG file of every figure by name; none of a training in which nothing happened."""
    arms, styles = {name: results[name] for name in summary["arms"]}, arm_styles(summary["arms"])
    trained = {name: runs for name, runs in arms.items() if runs[0].history}
    points = [point for runs in trained.values() for result in runs for point in result.history]
    figures = {"scatter": scatter_figure(summary["arms"], styles)}
    if any(np.isfinite(each.episode_return) or each.violation_steps or each.interventions for each in points):
        figures["training"] = training_figure(trained, styles)
    return {name: (figure.caption, figure.png) for name, figure in figures.items()}


def scatter_figure(summary: dict[str, dict[str, Any]], styles: Mapping[str, ArmStyle]) -> CaptionedFigure:
    """Returns mean return against violating episodes of every arm, a panel per scenario, from the arms' summaries."""
    caption = (
        "Cost and return in evaluation, better to the upper left. Markers are means over the runs of an arm, small dots"
        " runs. Vertical bars are Student's 95 % interval of the mean return over runs (of policies without training,"
        " over episodes; of one run there is no interval), horizontal bars Clopper and Pearson's 95 % interval of"
        " violating episodes given the trained agents; long ones leave the figure, tables have all ends. Markers differ"
        " in size only to show where they coincide. Violations are those of the true state, returns the environment's"
        " own, without penalties. Episodes that end early sum fewer steps."
    )
    scenarios = [AS_TRAINED, *next(iter(summary.values()))["conditions"]]
    with matplotlib.rc_context(STYLE):
        rows, columns = -(-len(scenarios) // _PANELS), min(len(scenarios), _PANELS)
        figure = CaptionedFigure((7.5 if columns == 1 else 5.0 * columns, 0.8 + 3.6 * rows), caption)
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
        sizes = np.linspace(*_SIZES, len(summary)).tolist()
        styles = {name: replace(styles[name], size=size) for name, size in zip(summary, sizes, strict=True)}
        for axis, scenario in zip(axes, scenarios, strict=False):
            for name, style in styles.items():
                _draw_evaluated(axis, style, summary[name] | summary[name]["conditions"].get(scenario, {}))
            title = scenario if len(scenarios) > 1 else ""
            label(axis, "violating evaluation episodes [%]", "mean return per episode", title)
            axis.label_outer()
        for axis in axes[len(scenarios) :]:
            axis.set_visible(False)
        high = max(max(axis.dataLim.x1 for axis in axes), 1.0)
        axes[0].set_xlim(-0.04 * high, 1.06 * high)  # space for markers at zero
        returns = [y for axis in axes for line in axis.get_lines() if line.get_ls() == "None" for y in line.get_ydata()]
        if (reach := max(returns) - min(returns)) > 0.0:
            axes[0].set_ylim(min(returns) - 0.25 * reach, max(returns) + 0.25 * reach)
        axes[0].xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
        axes[0].xaxis.set_major_formatter(thousands)
        axes[0].yaxis.set_major_formatter(thousands)
        legend_below(figure, {name: style.handle(line=False, points=True) for name, style in styles.items()})
        return figure


def _draw_evaluated(axis: Axes, style: ArmStyle, arm: dict[str, Any]) -> None:
    if arm["runs"] > 1:
        rates = [100.0 * rate for rate in arm["eval_violation_rate_by_run"]]
        dots = {"ms": 4.5, "mfc": style.color, "mec": "white", "mew": 0.6, "zorder": 2.5}
        axis.plot(rates, arm["eval_return_by_run"], ls="none", marker="o", **dots)
    rate, mean, means = 100.0 * arm["eval_violation_rate"], arm["eval_return_mean"], arm["eval_return_ci95"]
    bars = {"color": style.color, "lw": 1.3, "ms": 9.0, "mew": 1.3}
    if means is not None:
        axis.plot([rate] * 2, means, "-_", **bars)
    axis.plot([100.0 * end for end in arm["eval_violation_rate_ci95"]], [mean] * 2, "-|", **bars)
    axis.plot(rate, mean, ls="none", **style.points, zorder=3)


_TRAINING_CAPTION = (
    "Training. Lines are means over the runs of an arm, bands reach from the lowest to the highest run. Returns are"
    " those of recent finished episodes, with the penalties of arms that get some. Interventions are rates over the"
    f" last {RATE_WINDOW:,} steps (over all, before there are as many); a monitor's are what the shield would have"
    " overridden, its agent is the unshielded one. Episodes begin together: where those of all environments take more"
    " steps, rates rise and fall with them."
)


def training_figure(arms: ResultsByArm, styles: Mapping[str, ArmStyle]) -> CaptionedFigure:
    """Returns return, violating steps so far and, if an arm watches, intervention rate against training steps."""
    watching = [name for name in arms if Arm.of(name).mode is not None]
    few = False
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((11.0, 3.9), _TRAINING_CAPTION)
        axes = figure.subplots(1, 3 if watching else 2)
        for name, results in arms.items():
            steps, returns, violations, interventions = _histories(results)
            style, few = styles[name], few or len(steps) < _FEW_POINTS
            _draw_curve(axes[0], steps, returns, style)
            # Before the first step nothing has happened: true, and a curve even where the history is one point.
            _draw_curve(axes[1], np.array([0.0, *steps]), np.pad(violations, ((0, 0), (1, 0))), style)
            if name in watching:
                _draw_curve(axes[2], steps, 100.0 * _rates(steps, interventions), style)
        label(axes[0], "training steps", "mean return of recent episodes", "Return")
        label(axes[1], "training steps", "violating steps so far", "Violations of the true state")
        if watching:
            title = "Interventions" + " (monitor's: hypothetical)" * ("monitor" in arms)
            label(axes[2], "training steps", "actions overridden [%]", title)
        for axis in axes:
            axis.set_xlim(0.0, 1.04 * max(axes[1].dataLim.x1, 1.0))
            axis.xaxis.set_major_formatter(thousands)
            axis.yaxis.set_major_formatter(thousands)
            axis.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        for axis in axes[1:]:
            high = axis.dataLim.y1 if axis.dataLim.y1 > 0.0 else 1.0
            axis.set_ylim(-0.02 * high, 1.06 * high)  # a curve at zero keeps its width above the axis
        if not np.isfinite(axes[0].dataLim.y1):
            axes[0].text(0.5, 0.5, "no episode was finished", ha="center", transform=axes[0].transAxes)
        handles: dict[str, Artist] = {name: styles[name].handle(points=few) for name in arms}
        if any(len(results) > 1 for results in arms.values()):
            handles["lowest to highest run"] = Patch(color="#555555", alpha=0.2, lw=0.0)
        legend_below(figure, handles)
        return figure


def _histories(results: Sequence[RunResult]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns steps (points,), and returns, violating steps and interventions so far (runs, points) of an arm."""
    points = min(len(result.history) for result in results)
    names = ("steps", "episode_return", "violation_steps", "interventions")
    steps, *others = (
        np.array([[getattr(point, name) for point in result.history[:points]] for result in results], dtype=float)
        for name in names
    )
    return steps[0], *others  # type: ignore[return-value]


def _rates(steps: np.ndarray, totals: np.ndarray) -> np.ndarray:
    """Returns events per step over the last `RATE_WINDOW` steps from totals so far, each of shape (runs, points)."""
    past = np.maximum(steps - RATE_WINDOW, 0.0)
    before = np.array([np.interp(past, [0.0, *steps], [0.0, *row]) for row in totals])
    return (totals - before) / (steps - past)


def _draw_curve(axis: Axes, steps: np.ndarray, values: np.ndarray, style: ArmStyle) -> None:
    if len(values) > 1:
        axis.fill_between(steps, values.min(axis=0), values.max(axis=0), color=style.color, alpha=0.16, lw=0.0)
    points: dict[str, Any] = style.points if len(steps) < _FEW_POINTS else {}
    axis.plot(steps, values.mean(axis=0), lw=1.9, **style.line, **points)
