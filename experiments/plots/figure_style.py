"""What all figures share: a caption, the PNG file, settings of matplotlib, labels, legends, and the look of an arm."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.runs.arms import Arm
from ncs_gym import LinearPlant

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
_SQUARED = "\N{SUPERSCRIPT TWO}"


class CaptionedFigure(Figure):
    """A figure of matplotlib with a caption.

    Args:
        size: Width and height [inches].
        caption: Text below the figure.

    Attributes:
        caption: Text below the figure.
    """

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


def with_unit(name: str, unit: str) -> str:
    """Returns an axis label; some plants have no units."""
    return f"{name} [{unit}]".replace("^2", _SQUARED) if unit else name


def input_labels(plant: LinearPlant) -> tuple[str, ...]:
    """Returns what the entries of an input are, for axes: names, less the operating point, as "level - 1.16"."""
    return tuple(
        f"{name} {'+' if value < 0.0 else '-'} {abs(value):.4g}" if value else name
        for name, value in zip(plant.input_names, plant.operating_input.tolist(), strict=True)
    )


def label(axis: Axes, x: str, y: str, title: str = "") -> None:
    """Sets labels and title of an axis."""
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.set_title(title)


def legend_below(figure: Figure, handles: dict[str, Artist], rows: int = 1) -> None:
    """Puts one legend below a figure, where it covers no data, in at least `rows` rows and as many as it needs."""
    names, columns = list(handles), max(1, -(-len(handles) // rows))
    while columns > 1 and _width(names, columns) > figure.get_figwidth():
        columns -= 1
    figure.legend(list(handles.values()), names, loc="outside lower center", ncols=columns)


def thousands(value: float, _: object = None) -> str:
    """Returns a tick's text with thousands separators and a true minus sign."""
    return f"{value:,.12g}".replace("-", "\N{MINUS SIGN}")


def _width(names: list[str], columns: int) -> float:
    """Returns about how wide a legend is [inches]; matplotlib fills one column after the other."""
    return sum(_LETTER * max(map(len, part)) + _HANDLE for part in np.array_split(np.array(names), columns))


# Color (Okabe and Ito's palette, which color-blind readers can distinguish) and marker (for print without color).
ARM_COLORS_AND_MARKERS = {
    "unshielded": ("#D55E00", "o"),
    "shielded": ("#0072B2", "^"),
    "shielded:switch": ("#009E73", "P"),
    "shielded:boundary": ("#CC79A7", "X"),
    "shielded:lookahead": ("#000080", "p"),
    "penalized": ("#E69F00", "s"),
    "shielded:project": ("#56B4E9", "v"),
    "trusting": ("#7F0000", "<"),
    "psf": ("#117733", ">"),
    "lagrangian": ("#DDCC77", "d"),
    "monitor": ("#4D4D4D", "D"),
    "controller": ("#BBBBBB", "*"),
}
# Markers of policies that are not trained, in the color of what they are behind.
_CONTROLLER_MARKERS = {
    "lqr": "H",
    "mpc": "x",
    "random": "8",
    "K x_hat": "1",
    "zero input": "2",
    "untrained": "3",
    "pretrained": "*",
}
# Filters that share the color of another one.
_HOLLOW = ("psf:tube",)
_SOLID, _DOTTED, _DASHED = "-", (0, (1.0, 1.3)), (0, (4.5, 1.6))
# Dashes, and size of the marker [points], of an arm with a price of its own per violating step.
_PRICED, _PRICED_SIZE = (0, (12.0, 1.6)), 13.0


@dataclass(frozen=True)
class ArmStyle:
    """Style of an arm.

    Attributes:
        color: Hexadecimal color.
        dashes: Line style of matplotlib.
        marker: Marker of matplotlib.
        hollow: Whether markers are outlines.
        size: Size of the markers [points].
    """

    color: str
    dashes: Any
    marker: str
    hollow: bool
    size: float

    @classmethod
    def of(cls, name: str) -> ArmStyle:
        """Returns an arm's own style: the color stands for the shield, dashed lines and hollow markers for a penalty.

        Dotted lines and hollow markers stand for what acts in evaluation alone; so they do for the monitor, whose agent
        is the unshielded one and whose curves lie on that arm's. A price of one's own has long dashes and
        a large marker.

        Raises:
            ValueError: If the arm is unknown.
        """
        arm = Arm.of(name)
        color, marker = ARM_COLORS_AND_MARKERS[_look_of(arm)]
        if name == "monitor" or not arm.filters_training:
            return cls(color, _DOTTED, marker if arm.filters_training else "h", hollow=True, size=11.0)
        if not arm.is_trained:
            hollow = str(arm.mode).startswith(_HOLLOW)
            return cls(color, _DASHED, _CONTROLLER_MARKERS[arm.policy.partition(":")[0]], hollow, size=9.0)
        if arm.violation_weight is not None:
            return cls(color, _PRICED, marker, hollow=True, size=_PRICED_SIZE)
        changed = arm.penalizes_interventions or str(arm.mode).startswith(_HOLLOW)
        return cls(color, _DASHED if changed else _SOLID, marker, hollow=changed, size=10.0 if changed else 7.0)

    @property
    def line(self) -> dict[str, Any]:
        """Keyword arguments of matplotlib for lines."""
        return {"color": self.color, "ls": self.dashes}

    @property
    def points(self) -> dict[str, Any]:
        """Keyword arguments of matplotlib for markers; their fill is transparent."""
        return {
            "marker": self.marker,
            "ms": self.size,
            "mfc": "none" if self.hollow else to_rgba(self.color, 0.45),
            "mec": self.color,
            "mew": 1.3,
        }

    def handle(self, *, line: bool = True, points: bool = False) -> Line2D:
        """Returns the arm's entry in a legend."""
        shape = self.line | {"lw": 2.0} if line else {"ls": "none"}
        return Line2D([], [], **shape, **(self.points if points else {}))


def _look_of(arm: Arm) -> str:
    if not arm.is_trained and arm.mode is None:
        return "controller"
    if arm.penalizes_violations:
        return "lagrangian" if arm.adapts_penalty else "penalized"
    if arm.mode is None:
        return "unshielded"
    if not arm.is_shielded:
        return arm.mode.partition(":")[0]
    named = f"shielded:{arm.mode}"
    return named if named in arm.name or arm.mode == "lookahead" else "shielded"


def arm_styles(names: Iterable[str]) -> dict[str, ArmStyle]:
    """Returns the styles of arms that are drawn together: where two would share a color, the later gets a free one."""
    styles = {name: ArmStyle.of(name) for name in names}
    wanted, seen = {style.color for style in styles.values()}, set()
    free = iter([color for color, _ in ARM_COLORS_AND_MARKERS.values() if color not in wanted])
    for name, style in styles.items():
        styles[name] = replace(style, color=next(free, style.color)) if style.color in seen else style
        seen.add(style.color)
    return styles


def draw_estimate(
    axis: Axes, style: ArmStyle, rate: float, rates: list[float] | None, mean: float, means: list[float] | None
) -> None:
    """Draws a mean return against a rate [%], and their intervals where there are any."""
    if means is not None:
        axis.plot([100.0 * rate] * 2, means, "-_", color=style.color, lw=1.3, ms=9.0, mew=1.3)
    if rates is not None:
        axis.plot([100.0 * end for end in rates], [mean] * 2, "-|", color=style.color, lw=1.3, ms=9.0, mew=1.3)
    axis.plot(100.0 * rate, mean, ls="none", **style.points, zorder=3)
