"""Heatmaps of a sweep, a panel per arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from experiments.plots.figure_style import STYLE, CaptionedFigure, label, thousands
from experiments.runs.loops import losses_text
from ncs_gym.validation import counted

# What the axes of a panel do not show; see `_other`.
_Other = tuple[float | None, float, float | None, int | None]
# Name and values of an axis.
_Side = tuple[str, Sequence[Any]]
_SIDE_LABELS = {"delay": "delay [steps]", "downlink_loss": "loss of commands"}
# Letters of a title above an inch of a panel.
_LETTERS_PER_INCH = 11
# Largest number of panels side by side.
_COLUMNS = 4
# The scale of violating episodes reaches at least this far [%].
_LEAST_TOP = 10.0
# Fields whose relative luminance is smaller than this have light numbers; weights of red, green and blue.
_DARK = 0.45
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def sweep_map(cells: Sequence[dict[str, Any]], arms: Sequence[str]) -> CaptionedFigure:
    """Returns the violating episodes: a panel per arm and combination of what the axes do not show."""
    side = "delay" if all(cell.get("downlink_loss") is None for cell in cells) else "downlink_loss"
    losses, values = (sorted({cell[each] for cell in cells}) for each in ("loss", side))
    others = list(dict.fromkeys(_other(cell, side) for cell in cells))
    varied = [len(set(values)) > 1 for values in zip(*others, strict=True)]
    panels = {}
    for other, arm in product(others, arms):
        panel = panels[_title(arm, other, varied)] = np.full((len(values), len(losses)), np.nan)
        for cell in cells:
            if _other(cell, side) == other:
                rate = cell["arms"][arm]["eval_violation_rate"]
                panel[values.index(cell[side]), losses.index(cell["loss"])] = 100.0 * rate
    runs = max(cell["arms"][arm]["runs"] for cell in cells for arm in arms)
    caption = (
        "Violations: fraction of evaluation episodes in which the true state violates, over all runs of an arm. "
        f"{counted(runs, 'run')} per field."
    )
    if not varied[1] and cells[0]["burst_length"]:
        caption += f" Losses come in bursts of {cells[0]['burst_length']:g} packets on average."
    caption = " ".join(filter(None, (caption, losses_text(cells))))
    across = -(-len(arms) // -(-len(arms) // _COLUMNS))
    norm = Normalize(0.0, max(_LEAST_TOP, *(float(np.nanmax(panel)) for panel in panels.values())))
    sides: tuple[_Side, _Side] = (_SIDE_LABELS[side], values), ("loss probability", losses)
    return _maps(panels, *sides, "violating episodes [%]", "OrRd", norm, across, caption)


def _maps(
    panels: Mapping[str, np.ndarray],
    rows: _Side,
    columns: _Side,
    quantity: str,
    colors: str,
    norm: Normalize,
    across: int,
    caption: str,
) -> CaptionedFigure:
    """Returns a figure with a map per panel, `across` of them side by side."""
    down = -(-len(panels) // across)
    width = 1.8 + max(0.66 * len(columns[1]) + 0.3, 1.9) * across
    letters = int(_LETTERS_PER_INCH * (width - 1.8) / across)
    titles = {
        name: name if max(map(len, name.split("\n"))) <= letters else name.replace(", ", ",\n") for name in panels
    }
    further = max(0, max(title.count("\n") for title in titles.values()) - 1)  # lines of titles beyond two
    height = max(0.8 + max(0.46 * len(rows[1]) + 0.6 + 0.2 * further, 1.3) * down, 2.8)
    with matplotlib.rc_context(STYLE), matplotlib.rc_context({"axes.grid": False}):
        figure = CaptionedFigure((width, height), caption)
        axes = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
        for at, (title, axis) in enumerate(zip(panels, axes.flat, strict=False)):
            _draw_field(axis, panels[title], colors, norm)
            axis.set_xticks(range(len(columns[1])), [_shown(value) for value in columns[1]])
            axis.set_yticks(range(len(rows[1])), [_shown(value) for value in rows[1]])
            lowest = at + across >= len(panels)
            axis.tick_params(length=0, labelbottom=lowest)
            axis.spines[:].set_visible(False)
            label(axis, columns[0] if lowest else "", rows[0] if at % across == 0 else "", titles[title])
        for axis in axes.flat[len(panels) :]:
            axis.set_visible(False)
        figure.colorbar(ScalarMappable(norm, colors), ax=axes, label=fill(quantity, 30), format=thousands)
        return figure


def _draw_field(axis: Axes, values: np.ndarray, colors: str, norm: Normalize) -> None:
    """Draws a panel and writes the numbers into its fields, light on dark."""
    axis.imshow(values, cmap=colors, norm=norm, origin="lower", aspect="auto")
    digits = 1 if max(abs(norm.vmin or 0.0), abs(norm.vmax or 0.0)) >= 1.0 else 2
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            dark = np.array(matplotlib.colormaps[colors](norm(value))[:3]) @ _LUMINANCE < _DARK
            text = f"{value:z.{digits}f}".replace("-", "\N{MINUS SIGN}") if value else "0"
            axis.text(j, i, text, ha="center", va="center", fontsize=9, color="white" if dark else "#222222")


def _other(cell: dict[str, Any], side: str) -> _Other:
    """Returns what the axes do not show: quantization step, burst length, factor of the mass, and perhaps the delay."""
    delay = None if side == "delay" else cell["delay"]
    return cell["quantization_step"], cell["burst_length"], cell.get("mass_factor"), delay


def _title(arm: str, other: _Other, varied: Sequence[bool]) -> str:
    """Returns the name of an arm, and below it what differs between its panels."""
    quantization, burst, mass, delay = other
    texts = (
        "own quantization" if quantization is None else f"quantization {quantization:g}",
        f"bursts of {burst:g}" if burst else "independent losses",
        "own mass" if mass is None else f"{mass:g} times the mass",
        f"delay {delay}",
    )
    return f"{arm}\n{', '.join(text for text, differs in zip(texts, varied, strict=True) if differs)}".strip()


def _shown(value: Any) -> str:
    return "any" if value is None else f"{value:g}"
