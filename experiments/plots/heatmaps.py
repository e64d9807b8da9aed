"""Heatmaps of a sweep, a panel per arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from experiments.plots.figure_style import STYLE, CaptionedFigure, label, thousands
from experiments.runs.arms import Arm
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
# A color scale without a fixed start spans at least this fraction of the largest value: near ones look alike.
_SMALLEST_SPAN = 0.1
# Fields whose relative luminance is smaller than this have light numbers; weights of red, green and blue.
_DARK = 0.45
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


class _Quantity(NamedTuple):
    """What a heatmap shows: the entry `key` of an arm's summary times a factor, on a color scale from low to high.

    Without an end given, and beyond the highest one, the scale reaches to the values.
    """

    key: str
    title: str
    colors: str
    low: float | None
    high: float | None
    caption: str
    factor: float = 100.0
    of_shields: bool = False


_VIOLATIONS = "Violations: fraction of evaluation episodes in which the true state violates, over all runs of an arm."
_RETURN = "Return: mean of the evaluation episodes, without penalties; one color scale for all arms."
_INTERVENTIONS = "Interventions: fraction of the agent's actions in evaluation that the shield overrides."
QUANTITIES = {
    "violations": _Quantity("eval_violation_rate", "violating episodes [%]", "OrRd", 0.0, 10.0, _VIOLATIONS),
    "return": _Quantity("eval_return_mean", "mean return", "cividis", None, None, _RETURN, factor=1.0),
    "interventions": _Quantity(
        "intervention_rate", "actions overridden [%]", "PuBu", 0.0, None, _INTERVENTIONS, of_shields=True
    ),
}


def sweep_figures(summary: dict[str, Any], arms: Sequence[str]) -> dict[str, tuple[str, bytes]]:
    """Returns caption and PNG file of every figure by name; without an arm that has a shield, none of interventions."""
    figures = {}
    for name, quantity in QUANTITIES.items():
        shown = [arm for arm in arms if not quantity.of_shields or Arm.of(arm).mode is not None]
        if shown:
            figure = sweep_map(summary["cells"], shown, quantity)
            figures[name] = (figure.caption, figure.png)
    return figures


def sweep_map(cells: Sequence[dict[str, Any]], arms: Sequence[str], quantity: _Quantity) -> CaptionedFigure:
    """Returns one quantity: a panel per arm and combination of what the axes do not show."""
    side = "delay" if all(cell.get("downlink_loss") is None for cell in cells) else "downlink_loss"
    losses, values = (sorted({cell[each] for cell in cells}) for each in ("loss", side))
    others = list(dict.fromkeys(_other(cell, side) for cell in cells))
    varied = [len(set(values)) > 1 for values in zip(*others, strict=True)]
    panels = {}
    for other in others:
        for arm in arms:
            panel = panels[_title(arm, other, varied)] = np.full((len(values), len(losses)), np.nan)
            for cell in cells:
                if _other(cell, side) == other:
                    number = quantity.factor * cell["arms"][arm][quantity.key]
                    panel[values.index(cell[side]), losses.index(cell["loss"])] = number
    fields = list(panels.values())
    low = np.nanmin(fields) if quantity.low is None else quantity.low
    high = np.nanmax(fields) if quantity.high is None else max(quantity.high, np.nanmax(fields))
    if quantity.low is None and (missing := _SMALLEST_SPAN * max(abs(low), abs(high)) - (high - low)) > 0.0:
        low, high = low - missing / 2, high + missing / 2
    norm = Normalize(low, high if high > low else low + 1.0)  # a scale has a length where all values are zero, too
    runs = max(cell["arms"][arm]["runs"] for cell in cells for arm in arms)
    caption = f"{quantity.caption} {counted(runs, 'run')} per field."
    if quantity.of_shields and "monitor" in arms:
        caption += " The monitor's are what the shield would have overridden."
    if not varied[1] and cells[0]["burst_length"]:
        caption += f" Losses come in bursts of {cells[0]['burst_length']:g} packets on average."
    caption = " ".join(filter(None, (caption, losses_text(cells))))
    across = -(-len(arms) // -(-len(arms) // _COLUMNS))
    sides: tuple[_Side, _Side] = (_SIDE_LABELS[side], values), ("loss probability", losses)
    return _maps(panels, *sides, quantity.title, quantity.colors, norm, across, caption)


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
