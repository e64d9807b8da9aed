"""What all figures share: a caption, the PNG file, settings of matplotlib, labels and legends."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
