"""What all figures share: a caption, the PNG file, settings of matplotlib, labels, legends, and the look of an arm."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

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
