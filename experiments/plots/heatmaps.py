"""Heatmaps: those of a sweep, a panel per arm, and that of `ncs requirements`, where certificates end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Rectangle

from experiments.plots.figure_style import STYLE, CaptionedFigure, label, thousands, with_unit
from experiments.runs.arms import Arm

# What the axes of a panel do not show; see `_other`.
_Other = tuple[float | None, float, float | None, int | None]
_SIDE_LABELS = {"delay": "delay [steps]", "downlink_loss": "loss of commands"}
# Largest number of panels side by side.
_COLUMNS = 4
# Height at which the longest label of a color scale fits [inches].
_MIN_HEIGHT = 2.8
# A color scale without a fixed start spans at least this fraction of the largest value: near ones look alike.
_SMALLEST_SPAN = 0.1
# Fields whose relative luminance is smaller than this have light numbers; weights of red, green and blue.
_DARK = 0.45
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class _Quantity:
    """_Quantity that a heatmap shows.

    Attributes:
        key: Key of the quantity in an arm's summary.
        factor: Factor from the unit in the summary to the unit in the figure.
        title: Label of the color scale.
        unit: Unit in the figure.
        colors: Name of a color map of matplotlib.
        low: Start of the color scale; None for the smallest value.
        high: End of the color scale, unless a value is larger; None for the largest value.
        caption: First sentence of the caption.
        of_shields: Whether only arms with a shield have the quantity.
    """

    key: str
    factor: float
    title: str
    unit: str
    colors: str
    low: float | None
    high: float | None
    caption: str
    of_shields: bool = False


_QUANTITIES = {
    "violations": _Quantity(
        "eval_violation_rate",
        100.0,
        "violating evaluation episodes",
        "%",
        "OrRd",
        0.0,
        10.0,
        "Violations: fraction of evaluation episodes in which the true state violates, over all runs of an arm.",
    ),
    "return": _Quantity(
        "eval_return_mean",
        1.0,
        "mean return",
        "",
        "cividis",
        None,
        None,
        "Return: mean of the evaluation episodes, without penalties; one color scale for all arms.",
    ),
    "interventions": _Quantity(
        "intervention_rate",
        100.0,
        "actions overridden",
        "%",
        "PuBu",
        0.0,
        None,
        "Interventions: fraction of the agent's actions in evaluation that the shield overrides.",
        of_shields=True,
    ),
}


def sweep_figures(summary: dict[str, Any], arms: Sequence[str]) -> dict[str, tuple[str, bytes]]:
    """Returns caption and PNG file of every figure by name; without an arm that has a shield, none of interventions."""
    figures = {}
    for name, quantity in _QUANTITIES.items():
        shown = [arm for arm in arms if not quantity.of_shields or Arm.of(arm).mode is not None]
        if shown:
            figure = _heatmap(summary["cells"], shown, quantity)
            figures[name] = (figure.caption, figure.png)
    return figures


def _caption(quantity: _Quantity, cells: Sequence[dict[str, Any]], arms: Sequence[str]) -> str:
    runs = max(cell["arms"][arm]["runs"] for cell in cells for arm in arms)
    text = f"{quantity.caption} {runs} {'run' if runs == 1 else 'runs'} per field."
    if quantity.of_shields and "monitor" in arms:
        text += " The monitor's are what the shield would have overridden."
    return text


def _heatmap(cells: Sequence[dict[str, Any]], arms: Sequence[str], quantity: _Quantity) -> CaptionedFigure:
    """Returns one quantity: a panel per arm, a block of them per combination of what its axes do not show."""
    side = "delay" if all(cell.get("downlink_loss") is None for cell in cells) else "downlink_loss"
    losses, values = (sorted({cell[each] for cell in cells}) for each in ("loss", side))
    others = list(dict.fromkeys(_other(cell, side) for cell in cells))
    fields = {(arm, other): _field(cells, arm, other, quantity, losses, side) for other in others for arm in arms}
    norm = _norm(list(fields.values()), quantity)
    block = -(-len(arms) // _COLUMNS)
    columns, rows = -(-len(arms) // block), block * len(others)
    height = 0.5 * len(values) + (0.65 if len(others) > 1 else 0.45)
    with matplotlib.rc_context(STYLE), matplotlib.rc_context({"axes.grid": False}):
        width = 1.8 + max(0.68 * len(losses) + 0.15, 1.7) * columns
        size = (width, max(0.7 + max(height, 1.3) * rows, _MIN_HEIGHT))
        figure = CaptionedFigure(size, _caption(quantity, cells, arms))
        panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for at, panel in enumerate(panels.flat):
            row, column = divmod(at, columns)
            arm_at = row % block * columns + column
            panel.set_visible(arm_at < len(arms))
            if not panel.get_visible():
                continue
            arm, other = arms[arm_at], others[row // block]
            draw_field(panel, fields[arm, other], quantity.colors, norm)
            panel.set_title(_title(arm, other, len(others) > 1))
            below = row + 1 < rows and (row % block + 1 == block or arm_at + columns < len(arms))
            _name_axes(panel, losses, values, _SIDE_LABELS[side] if column == 0 else "", lowest=not below)
        mappable = ScalarMappable(norm, quantity.colors)
        figure.colorbar(mappable, ax=panels, label=with_unit(quantity.title, quantity.unit), format=thousands)
        return figure


def _other(cell: dict[str, Any], side: str) -> _Other:
    """Returns what the axes do not show: quantization step, burst length, factor of the mass, and perhaps the delay."""
    delay = None if side == "delay" else cell["delay"]
    return cell["quantization_step"], cell["burst_length"], cell.get("mass_factor"), delay


def _field(
    cells: Sequence[dict[str, Any]],
    arm: str,
    other: _Other,
    quantity: _Quantity,
    losses: list[float],
    side: str,
) -> np.ndarray:
    """Returns the values of a panel, shape (values of the side, losses)."""
    rows = sorted({cell[side] for cell in cells})
    values = np.full((len(rows), len(losses)), np.nan)
    for cell in cells:
        if _other(cell, side) == other:
            at = rows.index(cell[side]), losses.index(cell["loss"])
            values[at] = quantity.factor * cell["arms"][arm][quantity.key]
    return values


def _norm(fields: Sequence[np.ndarray], quantity: _Quantity) -> Normalize:
    low = np.nanmin(fields) if quantity.low is None else quantity.low
    high = np.nanmax(fields) if quantity.high is None else max(quantity.high, np.nanmax(fields))
    if quantity.low is None and (missing := _SMALLEST_SPAN * max(abs(low), abs(high)) - (high - low)) > 0.0:
        low, high = low - missing / 2, high + missing / 2
    # Where all values are zero the scale still has a length.
    return Normalize(low, high if high > low else low + 1.0)


def draw_field(axis: Axes, values: np.ndarray, colors: str, norm: Normalize) -> None:
    """Draws a panel and writes the numbers into its fields, light on dark."""
    axis.imshow(values, cmap=colors, norm=norm, origin="lower", aspect="auto")
    digits = 1 if max(abs(norm.vmin or 0.0), abs(norm.vmax or 0.0)) >= 1.0 else 2
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            dark = np.array(matplotlib.colormaps[colors](norm(value))[:3]) @ _LUMINANCE < _DARK
            text = f"{value:z.{digits}f}".replace("-", "\N{MINUS SIGN}") if value else "0"
            axis.text(j, i, text, ha="center", va="center", fontsize=9, color="white" if dark else "#222222")


def _name_axes(axis: Axes, losses: list[float], values: list[float], left: str, lowest: bool) -> None:
    axis.set_xticks(range(len(losses)), [f"{loss:g}" for loss in losses])
    axis.set_yticks(range(len(values)), [f"{value:g}" for value in values])
    axis.tick_params(length=0, labelbottom=lowest, labelleft=bool(left))
    axis.spines[:].set_visible(False)
    label(axis, "loss probability" if lowest else "", left, axis.get_title())


def _title(arm: str, other: _Other, several: bool) -> str:
    quantization, burst, mass, delay = other
    if not several:
        return arm
    losses = f"bursts of {burst:g}" if burst else "independent losses"
    late = "" if delay is None else f"delay {delay}, "
    factor = "" if mass is None else f", {mass:g} times the mass"
    return f"{arm}\n{late}{'' if quantization is None else f'quantization {quantization:g}, '}{losses}{factor}"


_MAPS_SIDE_BY_SIDE = 3
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
    across = min(len(panels), _MAPS_SIDE_BY_SIDE)
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
