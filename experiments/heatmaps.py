"""Heatmaps of a sweep: a panel per arm, losses against delays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from experiments.plotting import STYLE, as_png

# Quantity by name of the figure: key in an arm's summary, factor, title, color map, range.
QUANTITIES = {
    "violations": ("eval_violation_rate", 100.0, "violating evaluation episodes [%]", "OrRd", (0.0, 100.0)),
    "interventions": ("intervention_rate", 100.0, "actions overridden [%]", "PuBu", (0.0, None)),
    "return": ("eval_return_mean", 1.0, "mean return", "viridis", (None, None)),
}


def heatmaps_of(summary: dict[str, Any], arms: Sequence[str]) -> dict[str, tuple[str, bytes]]:
    """Returns caption and PNG of every figure by name."""
    return {
        name: (f"{title[0].upper()}{title[1:]}, by channel and arm.", as_png(_figure(summary["cells"], arms, name)))
        for name, (_, _, title, _, _) in QUANTITIES.items()
    }


def _figure(cells: Sequence[dict[str, Any]], arms: Sequence[str], name: str) -> Figure:
    """Returns one quantity: a column per arm, a row per combination of rounding and burst length."""
    key, factor, title, colors, (low, high) = QUANTITIES[name]
    losses, delays = (sorted({cell[side] for cell in cells}) for side in ("loss", "delay"))
    others = list(dict.fromkeys((cell["quantization_step"], cell["burst_length"]) for cell in cells))
    values = {(arm, other): np.full((len(delays), len(losses)), np.nan) for arm in arms for other in others}
    for cell in cells:
        other = cell["quantization_step"], cell["burst_length"]
        for arm in arms:
            at = delays.index(cell["delay"]), losses.index(cell["loss"])
            values[arm, other][at] = factor * cell["arms"][arm][key]
    everything = np.concatenate([panel.ravel() for panel in values.values()])
    low, high = np.nanmin(everything) if low is None else low, np.nanmax(everything) if high is None else high
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        size = (1.6 + 1.0 * len(losses) * len(arms) + 0.8, 1.2 + (0.7 * len(delays) + 0.5) * len(others))
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(others), len(arms), squeeze=False, sharex=True, sharey=True)
        for row, other in zip(axes, others, strict=True):
            for axis, arm in zip(row, arms, strict=True):
                image = axis.imshow(
                    values[arm, other], cmap=colors, vmin=low, vmax=max(high, low + 1e-9), origin="lower", aspect="auto"
                )
                _write_values(axis, values[arm, other], low, high, dark_high=colors != "viridis")
                axis.set_title(_title(arm, other, len(others) > 1), fontsize=10)
                axis.set_xticks(range(len(losses)), [f"{loss:g}" for loss in losses])
                axis.set_yticks(range(len(delays)), [str(delay) for delay in delays])
                axis.tick_params(length=0)
            row[0].set_ylabel("delay [steps]")
        for axis in axes[-1]:
            axis.set_xlabel("loss probability")
        figure.colorbar(image, ax=axes, label=title, shrink=0.9)
        return figure


def _write_values(axis: Any, values: np.ndarray, low: float, high: float, dark_high: bool) -> None:
    """Writes the numbers into the fields, light on dark."""
    for (i, j), value in np.ndenumerate(values):
        share = (value - low) / (high - low) if high > low else 0.0
        dark = share > 0.6 if dark_high else share < 0.5
        axis.text(j, i, f"{value:.1f}", ha="center", va="center", fontsize=9, color="white" if dark else "#222222")


def _title(arm: str, other: tuple[float | None, float], several: bool) -> str:
    rounding, burst = other
    if not several:
        return arm
    return f"{arm}: {'' if rounding is None else f'rounding {rounding:g}, '}bursts of {burst:g}"
