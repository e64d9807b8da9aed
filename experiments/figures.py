"""The figures of the comparison."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.unit import UnitResult
from ncs_gym import LinearPlant
from shields import Certificate

COLORS = {"unshielded": "#c8553d", "shielded": "#1f6f8b"}
GREY = "#555555"
STYLE = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "legend.frameon": False,
    "figure.dpi": 130,
}


def training_figure(arms: dict[str, Sequence[UnitResult]]) -> Figure:
    """Returns return, violating steps so far and intervention rate against training steps; a line per run."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 3.4), layout="constrained")
        axes = figure.subplots(1, 3)
        for name, results in arms.items():
            for i, result in enumerate(results):
                label = name if i == 0 else None
                steps = np.array([point.steps for point in result.history])
                color = COLORS[name]
                axes[0].plot(
                    steps, [point.episode_return for point in result.history], color=color, label=label, lw=1.4
                )
                axes[1].plot(
                    steps, [point.violation_steps for point in result.history], color=color, label=label, lw=1.4
                )
                overridden = np.array([point.interventions for point in result.history])
                rate = np.diff(overridden, prepend=0) / np.diff(steps, prepend=0)
                if name == "shielded":
                    axes[2].plot(steps, 100.0 * rate, color=color, label=label, lw=1.4)
        _label(axes[0], "training steps", "mean return of recent episodes", "Return")
        _label(axes[1], "training steps", "violating steps so far", "Violations of the true state")
        _label(axes[2], "training steps", "actions overridden [%]", "Interventions of the shield")
        axes[2].set_ylim(bottom=0.0)
        for axis in axes[:2]:
            axis.legend()
        for axis in axes:
            axis.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:.0f}k")
        return figure


def phase_figure(plant: LinearPlant, certificate: Certificate, arms: dict[str, Sequence[UnitResult]]) -> Figure:
    """Returns the first two states of the first evaluation episode of each run, with safe box and safe set."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 4.8), layout="constrained")
        axes = figure.subplots(1, len(arms), sharex=True, sharey=True, squeeze=False)[0]
        for axis, (name, results) in zip(axes, arms.items(), strict=True):
            for i, result in enumerate(results):
                states = result.trajectory.states
                axis.plot(
                    states[:, 0],
                    states[:, 1],
                    color=COLORS[name],
                    lw=0.9,
                    alpha=0.85,
                    label=None if i else "true state",
                )
                outside = plant.constraint_values(states.T).max(axis=0) > 0.0
                if outside.any():
                    axis.plot(*states[outside, :2].T, "x", color="black", ms=5, label=None if i else "violation")
            _draw_sets(axis, plant, certificate)
            titles = [
                f"{label} [{unit}]" if unit else label
                for label, unit in zip(plant.state_names, plant.state_units, strict=True)
            ]
            _label(axis, titles[0], titles[1] if axis is axes[0] else "", f"{name}: one evaluation episode per run")
            axis.legend(loc="upper left", fontsize=8.5)
        return figure


def episode_figure(plant: LinearPlant, arms: dict[str, Sequence[UnitResult]]) -> Figure:
    """Returns the largest |c_j x| and the inputs over time in the same evaluation episode of both arms' first runs."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 4.8), layout="constrained")
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1, 1))
        for name, results in arms.items():
            path = results[0].trajectory
            time = plant.dt * np.arange(len(path.states))
            top.plot(time, np.abs(path.states @ plant.C.T).max(axis=1), color=COLORS[name], lw=1.3, label=name)
            bottom.step(
                time[:-1], path.inputs[:, 0], where="post", color=COLORS[name], lw=1.2, label=f"applied, {name}"
            )
            changed = np.any(path.inputs != path.proposed, axis=1)
            if changed.any():
                bottom.plot(
                    time[:-1][changed], path.proposed[changed, 0], ".", color=GREY, ms=4, label="proposed, overridden"
                )
        top.axhline(1.0, color="black", lw=1.0, ls="--")
        top.annotate("limit", (0.0, 1.0), xytext=(2, 3), textcoords="offset points", fontsize=8.5)
        _label(top, "", "largest |c_j x|", "The same episode with and without the shield")
        unit = f" [{plant.input_units[0]}]" if plant.input_units[0] else ""
        _label(bottom, "time [s]", f"{plant.input_names[0]}{unit}", "")
        top.legend(loc="upper right", ncols=2)
        bottom.legend(loc="upper right", ncols=3, fontsize=8.5)
        bottom.set_ylim(-1.1 * plant.u_max[0], 1.55 * plant.u_max[0])
        return figure


def as_png(figure: Figure) -> bytes:
    """Returns a figure as a PNG file's bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": ""})
    return buffer.getvalue()


def _draw_sets(axis: Axes, plant: LinearPlant, certificate: Certificate) -> None:
    """Draws the safe set's and the safe box's extent in the plane of the first two states."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    plane = certificate.L[:2, :2]
    axis.plot(*(np.linalg.cholesky(plane) @ circle), color="black", lw=1.3, label="safe set S")
    if plant.C.shape == (2, 2):
        corners = np.linalg.solve(plant.C, np.array([[1, 1, -1, -1, 1], [1, -1, -1, 1, 1]], dtype=float))
        axis.plot(*corners, color="black", lw=1.0, ls="--", label="safe box")


def _label(axis: Axes, x: str, y: str, title: str) -> None:
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.set_title(title, fontsize=10.5)
