"""The heatmap of a sweep, a panel per arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from experiments.plots.figure_style import STYLE, CaptionedFigure, label, thousands
from ncs_gym.validation import counted

# Largest number of panels side by side.
_COLUMNS = 4
# The scale of violating episodes reaches at least this far [%]; above its middle numbers are light.
_LEAST_TOP = 10.0


def sweep_map(cells: Sequence[dict[str, Any]], arms: Sequence[str]) -> CaptionedFigure:
    """Returns the violating episodes of every arm, over losses and delays."""
    losses, delays = (sorted({cell[side] for cell in cells}) for side in ("loss", "delay"))
    panels = np.full((len(arms), len(delays), len(losses)), np.nan)
    for cell in cells:
        rates = [100.0 * cell["arms"][arm]["eval_violation_rate"] for arm in arms]
        panels[:, delays.index(cell["delay"]), losses.index(cell["loss"])] = rates
    runs = max(arm["runs"] for cell in cells for arm in cell["arms"].values())
    caption = (
        "Violations: fraction of evaluation episodes in which the true state violates, over all runs of an arm. "
        f"{counted(runs, 'run')} per field."
    )
    down = -(-len(arms) // _COLUMNS)
    across = -(-len(arms) // down)
    norm = Normalize(0.0, max(_LEAST_TOP, float(np.nanmax(panels))))
    size = 1.8 + max(0.66 * len(losses) + 0.3, 1.9) * across, max(0.8 + max(0.46 * len(delays) + 0.6, 1.3) * down, 2.8)
    with matplotlib.rc_context(STYLE), matplotlib.rc_context({"axes.grid": False}):
        figure = CaptionedFigure(size, caption)
        axes = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
        for name, panel, axis in zip(arms, panels, axes.flat, strict=False):
            axis.imshow(panel, cmap="OrRd", norm=norm, origin="lower", aspect="auto")
            for (i, j), value in np.ndenumerate(panel):
                color = "white" if norm(value) > 0.5 else "#222222"
                axis.text(j, i, f"{value:.1f}" if value else "0", ha="center", va="center", fontsize=9, color=color)
            axis.set_xticks(range(len(losses)), [f"{loss:g}" for loss in losses])
            axis.set_yticks(range(len(delays)), [f"{delay}" for delay in delays])
            axis.tick_params(length=0)
            axis.spines[:].set_visible(False)
            label(axis, "loss probability", "delay [steps]", name)
            axis.label_outer()
        for axis in axes.flat[len(arms) :]:
            axis.set_visible(False)
        figure.colorbar(ScalarMappable(norm, "OrRd"), ax=axes, label="violating episodes [%]", format=thousands)
        return figure
