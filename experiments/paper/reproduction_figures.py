"""Figures of the reproduction: states and inputs of every design."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from experiments.paper.reproduction import Simulation
from experiments.plots.figure_style import STYLE, CaptionedFigure, with_unit

_COLOR = "#1f6f8b"
# The transient is over after these steps; the other inputs are near zero.
_SHOWN_STEPS = 40


def reproduction_figures(simulations: Sequence[Simulation]) -> dict[str, bytes]:
    """Returns the PNG files of the states and of the inputs, by name."""
    return {
        "states": _panels(simulations, _draw_states).png,
        "inputs": _panels(simulations, _draw_inputs).png,
    }


def _panels(simulations: Sequence[Simulation], draw: Callable[[Axes, Simulation], None]) -> CaptionedFigure:
    """Returns one panel per design, with one legend below."""
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((12, 4.8))
        axes = figure.subplots(1, len(simulations), sharey=True)
        for axis, simulation in zip(axes, simulations, strict=True):
            draw(axis, simulation)
            axis.set_title(simulation.design.name, fontsize=10.5)
            if axis is not axes[0]:
                axis.set_ylabel("")
        handles, labels = axes[0].get_legend_handles_labels()
        legend = figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        for handle in legend.get_lines():  # what is drawn thin and faint a hundred times is not seen once
            handle.set(lw=1.6, alpha=1.0)
        return figure


def _draw_states(axis: Axes, simulation: Simulation) -> None:
    """Draws the trajectories, the safe set and the safe box."""
    design = simulation.design
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for i, path in enumerate(simulation.states):
        label = None if i else "true state"
        axis.plot(path[:, 0], path[:, 1], color=_COLOR, lw=0.6, alpha=0.5, label=label)
    axis.plot(*(np.linalg.cholesky(design.L) @ circle), color="black", lw=1.4, label="safe set")
    corners = np.linalg.solve(design.plant.box_rows, np.array([[1, 1, -1, -1, 1], [1, -1, -1, 1, 1]], dtype=float))
    axis.plot(*corners, color="black", lw=1.0, ls="--", label="safe box")
    axis.set_xlabel("coupling stretch [m]")
    axis.set_ylabel("stretch rate [m/s]")
    axis.set_aspect("equal")


def _draw_inputs(axis: Axes, simulation: Simulation) -> None:
    """Draws the inputs asked for during the transient, the limits, and what was asked beyond them."""
    plant, shown = simulation.design.plant, simulation.inputs[:, :_SHOWN_STEPS]
    time, limit = plant.dt * np.arange(shown.shape[1]), plant.u_max[0]
    for i, path in enumerate(shown):
        axis.plot(time, path, color=_COLOR, lw=0.6, alpha=0.5, label=None if i else "K x_hat")
    for sign in (-1.0, 1.0):
        axis.axhline(sign * limit, color="black", ls="--", lw=1.0, label="input limit" if sign > 0 else None)
    starts, steps = np.nonzero(np.abs(shown) > limit)
    axis.plot(time[steps], shown[starts, steps], "x", color="#c8553d", ms=7, label="beyond the limit")
    axis.set_xlabel(f"time [s], first {_SHOWN_STEPS} steps")
    axis.set_ylabel(with_unit("input asked for", "m/s^2"))
