"""The figures of the comparison."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.plotting import STYLE, as_png
from experiments.unit import UnitResult
from ncs_gym import LinearPlant
from shields import Certificate

COLORS = {
    "unshielded": "#c8553d",
    "monitor": "#8a5a44",
    "penalized": "#e09f3e",
    "shielded": "#1f6f8b",
}
GREY = "#555555"
# Curves of fewer points show them.
FEW_POINTS = 5


# Interventions are averaged over as many steps as 64 environments side by side need for an episode of 200.
RATE_WINDOW = 64 * 200


def figures_of(
    plant: LinearPlant, certificate: Certificate, summary: dict[str, Any], results: dict[str, Sequence[UnitResult]]
) -> dict[str, tuple[str, bytes]]:
    """Returns caption and PNG of every figure by name."""
    arms = {name: results[name] for name in summary["arms"]}
    return {
        "training": ("Training: thin lines are single runs, thick ones their mean.", as_png(training_figure(arms))),
        "phase": (
            "True states of the first evaluation episode of each run.",
            as_png(phase_figure(plant, certificate, arms)),
        ),
        "episode": (
            "One evaluation episode of the first runs, same draws of nature.",
            as_png(episode_figure(plant, arms)),
        ),
    }


def color_of(arm: str) -> str:
    """Returns the color of an arm; its variants share it."""
    return COLORS[arm.split(":")[0].split("+")[0]]


def training_figure(arms: dict[str, Sequence[UnitResult]]) -> Figure:
    """Returns return, violating steps so far and intervention rate against training steps; a thin line per run."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 3.4), layout="constrained")
        axes = figure.subplots(1, 3)
        for name, results in arms.items():
            steps = np.array([point.steps for point in results[0].history])
            overridden = _per_run(results, "interventions")
            past = np.maximum(steps - RATE_WINDOW, 0)
            before = np.array([np.interp(past, [0, *steps], [0, *row]) for row in overridden])
            rates = 100.0 * (overridden - before) / (steps - past)
            curves = [_per_run(results, "episode_return"), _per_run(results, "violation_steps"), rates]
            for axis, values in zip(axes, curves, strict=True):
                if axis is axes[2] and not overridden.any():
                    continue
                axis.plot(steps, values.T, color=color_of(name), lw=0.8, alpha=0.4)
                marker = "o" if len(steps) < FEW_POINTS else None
                axis.plot(steps, values.mean(axis=0), color=color_of(name), lw=2.0, marker=marker, label=name)
        _label(axes[0], "training steps", "mean return of recent episodes", "Return")
        _label(axes[1], "training steps", "violating steps so far", "Violations of the true state")
        _label(axes[2], "training steps", "actions overridden [%]", "Interventions of the shield")
        axes[2].set_ylim(bottom=0.0)
        axes[1].yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        for axis in axes:
            axis.legend()
            axis.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k")
        return figure


def phase_figure(plant: LinearPlant, certificate: Certificate, arms: dict[str, Sequence[UnitResult]]) -> Figure:
    """Returns the first two states of the first evaluation episode of each run, with safe box and safe set."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 5.0), layout="constrained")
        axes = figure.subplots(1, len(arms), sharex=True, sharey=True, squeeze=False)[0]
        x, y = (_with_unit(*pair) for pair in zip(plant.state_names[:2], plant.state_units[:2], strict=True))
        handles = {}
        for axis, (name, results) in zip(axes, arms.items(), strict=True):
            for result in results:
                states = result.trajectory.states
                (handles[name],) = axis.plot(states[:, 0], states[:, 1], color=color_of(name), lw=0.9, alpha=0.85)
                outside = plant.constraint_values(states.T).max(axis=0) > 0.0
                if outside.any():
                    (handles["violation"],) = axis.plot(*states[outside, :2].T, "x", color="black", ms=5)
            handles |= _draw_sets(axis, plant, certificate)
            _label(axis, x, y if axis is axes[0] else "", f"{name}: one evaluation episode per run")
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
        return figure


def episode_figure(plant: LinearPlant, arms: dict[str, Sequence[UnitResult]]) -> Figure:
    """Returns the largest |c_j x| and the inputs over time in the same evaluation episode of both arms' first runs."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 4.8), layout="constrained")
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1, 1))
        for name, results in arms.items():
            path = results[0].trajectory
            time = plant.dt * np.arange(len(path.states))
            top.plot(time, np.abs(path.states @ plant.C.T).max(axis=1), color=color_of(name), lw=1.3, label=name)
            bottom.step(
                time[:-1], path.inputs[:, 0], where="post", color=color_of(name), lw=1.2, label=f"applied, {name}"
            )
            changed = np.any(path.inputs != path.proposed, axis=1)
            if changed.any():
                bottom.plot(
                    time[:-1][changed], path.proposed[changed, 0], ".", color=GREY, ms=4, label="proposed, overridden"
                )
        top.axhline(1.0, color="black", lw=1.0, ls="--")
        top.annotate("limit", (0.0, 1.0), xytext=(2, 3), textcoords="offset points", fontsize=8.5)
        _label(top, "", "largest |c_j x|", "The same episode with and without the shield")
        _label(bottom, "time [s]", _with_unit(plant.input_names[0], plant.input_units[0]), "")
        top.set_ylim(top=1.2 * top.get_ylim()[1])  # room for the legend
        top.legend(loc="upper right", ncols=2)
        bottom.legend(loc="upper right", ncols=3, fontsize=8.5)
        for limit in (-plant.u_max[0], plant.u_max[0]):
            bottom.axhline(limit, color="black", lw=1.0, ls="--")
        bottom.set_ylim(-1.1 * plant.u_max[0], 1.6 * plant.u_max[0])
        return figure


def _per_run(results: Sequence[UnitResult], name: str) -> np.ndarray:
    """Returns one quantity of the training history, shape (runs, rollouts)."""
    return np.array([[getattr(point, name) for point in result.history] for result in results])


def _draw_sets(axis: Axes, plant: LinearPlant, certificate: Certificate) -> dict[str, Line2D]:
    """Draws the extent of safe set and safe box in the plane of the first two states."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    plane = certificate.L[:2, :2]
    handles = {"safe set S": axis.plot(*(np.linalg.cholesky(plane) @ circle), color="black", lw=1.3)[0]}
    if plant.C.shape == (2, 2):
        corners = np.linalg.solve(plant.C, np.array([[1, 1, -1, -1, 1], [1, -1, -1, 1, 1]], dtype=float))
        handles["safe box"] = axis.plot(*corners, color="black", lw=1.0, ls="--")[0]
    return handles


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _label(axis: Axes, x: str, y: str, title: str) -> None:
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.set_title(title, fontsize=10.5)
