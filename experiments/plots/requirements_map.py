"""The figure of `ncs requirements`: what share of the box each network keeps, and where certificates end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Rectangle

from experiments.plots.figure_style import STYLE, CaptionedFigure, label
from experiments.plots.heatmaps import draw_field

_COLUMNS = 3
_BOUNDARY, _TODAY = "#c1272d", "#ff9800"


def requirements_map(
    panels: Mapping[str, np.ndarray],
    rows: tuple[str, Sequence[Any]],
    columns: tuple[str, Sequence[Any]],
    today: tuple[str, int, int] | None,
    quantity: str = "share of the box [%]",
) -> CaptionedFigure:
    """Returns a heatmap per panel, with a line around the fields without a certificate.

    Args:
        panels: Values by title, each of shape (rows, columns); NaN where no certificate was found.
        rows: Name and values of the vertical axis.
        columns: Name and values of the horizontal axis.
        today: Title of the panel, row and column of the channel that the environment has now; None if it is not there.
        quantity: What the values are.
    """
    largest = max((float(np.nanmax(panel)) for panel in panels.values() if np.isfinite(panel).any()), default=1.0)
    norm = Normalize(0.0, largest)
    across = min(len(panels), _COLUMNS)
    down = -(-len(panels) // across)
    size = (
        1.9 + max(0.62 * len(columns[1]) + 0.6, 2.2) * across,
        max(0.9 + (0.42 * len(rows[1]) + 0.6) * down, 2.8),
    )
    caption = (
        f"A field is a network, its number the {quantity}, proved by a certificate. In the empty fields, beyond the "
        "red line, no certificate was found, which does not prove that there is none."
    )
    if today is not None:
        caption += " The orange frame is the channel of today."
    with matplotlib.rc_context(STYLE), matplotlib.rc_context({"axes.grid": False}):
        figure = CaptionedFigure(size, caption)
        axes = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
        for at, axis in enumerate(axes.flat):
            axis.set_visible(at < len(panels))
        for at, (title, panel) in enumerate(panels.items()):
            axis = axes.flat[at]
            draw_field(axis, panel, "YlGnBu", norm)
            _draw_boundary(axis, np.isfinite(panel))
            if today is not None and today[0] == title:
                corner = (today[2] - 0.5, today[1] - 0.5)
                axis.add_patch(Rectangle(corner, 1.0, 1.0, fill=False, color=_TODAY, linewidth=3.0, zorder=3))
            axis.set_xticks(range(len(columns[1])), [_shown(value) for value in columns[1]])
            axis.set_yticks(range(len(rows[1])), [_shown(value) for value in rows[1]])
            axis.tick_params(length=0)
            lowest = at + across >= len(panels)
            axis.tick_params(labelbottom=lowest)
            label(axis, columns[0] if lowest else "", rows[0] if at % across == 0 else "", title)
        figure.colorbar(ScalarMappable(norm, "YlGnBu"), ax=axes, label=quantity)
        return figure


def _draw_boundary(axis: Axes, possible: np.ndarray) -> None:
    """Draws a line between fields with and without a certificate."""
    down, across = possible.shape
    for i in range(down):
        for j in range(across):
            if j + 1 < across and possible[i, j] != possible[i, j + 1]:
                axis.plot([j + 0.5] * 2, [i - 0.5, i + 0.5], color=_BOUNDARY, linewidth=2.0)
            if i + 1 < down and possible[i, j] != possible[i + 1, j]:
                axis.plot([j - 0.5, j + 0.5], [i + 0.5] * 2, color=_BOUNDARY, linewidth=2.0)
    axis.set_xlim(-0.5, across - 0.5)
    axis.set_ylim(-0.5, down - 0.5)


def _shown(value: Any) -> str:
    return "any" if value is None else f"{value:g}"
