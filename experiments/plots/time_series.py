"""One episode over time: distance to the limits, inputs, interventions and packets."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D

from agents.results import Trajectory
from experiments.plots.figure_style import STYLE, ArmStyle, CaptionedFigure, label, legend_below, with_unit
from experiments.runs.arms import Arm, ResultsByArm
from ncs_gym import LinearPlant

_INK = "#222222"
# Line widths of the arms shown: where lines coincide, the lower one is visible.
_WIDTHS = (2.6, 1.2)
_LIMIT = {"color": _INK, "lw": 1.0, "ls": (0, (6.0, 3.0))}


def _shown_arms(names: Sequence[str]) -> list[str]:
    """Returns the pair to show: the unshielded arm, or else another one without a shield, and the first shielded one.

    There are fewer where no arm is shielded or all are.
    """
    shielded = [name for name in names if Arm.of(name).is_shielded]
    bare = sorted((name for name in names if name not in shielded), key=lambda name: name != "unshielded")
    return bare[:1] + shielded[:1]


def episode_figure(plant: LinearPlant, arms: ResultsByArm) -> CaptionedFigure:
    """Returns the same evaluation episode of the first runs of the shown arms.

    From above: the largest |c_j x| of state and estimate, a panel per input, and a row of ticks per kind of event.
    """
    paths = {name: arms[name][0].trajectory for name in _shown_arms(list(arms))}
    events = _events(paths, plant)
    heights = [1.5, *[1.0] * plant.m, 0.16 + 0.17 * len(events)]
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((11.0, 1.2 + 1.45 * sum(heights)), _caption(arms))
        axes = figure.subplots(2 + plant.m, 1, sharex=True, height_ratios=heights)
        handles = _draw_states(axes[0], paths, plant)
        for i in range(plant.m):
            handles |= _draw_input(axes[1 + i], paths, plant, i)
        _draw_events(axes[-1], events)
        label(axes[-1], "time [s]", "")
        axes[-1].set_xlim(0.0, plant.dt * max(len(path.inputs) for path in paths.values()))
        figure.align_ylabels(axes[:-1])
        legend_below(figure, handles, rows=2)
        return figure


def _caption(arms: ResultsByArm) -> str:
    """Returns the caption: which episode is shown, and what is marked."""
    names = _shown_arms(list(arms))
    paths = [arms[name][0].trajectory for name in names]
    text = f"Time series: the first evaluation episode of the first run, {' and '.join(names)}"
    text += ", with common random numbers." if len(names) > 1 else "."
    text += (
        " Above, how close true state and estimate come to the limits: one beyond 1 violates a limit. Below, the"
        " applied inputs. Ticks mark packet arrivals and interventions"
    )
    text += "; the monitor's are what the shield would have done." if "monitor" in names else "."
    if len({len(path.inputs) for path in paths}) > 1:
        text += " An episode that is shorter ended at its first violation."
    return text


def _draw_states(axis: Axes, paths: dict[str, Trajectory], plant: LinearPlant) -> dict[str, Artist]:
    """Draws the largest |c_j x| of states and estimates, and marks the violations."""
    handles: dict[str, Artist] = {}
    crosses: list[Line2D] = []
    for (name, path), width in zip(paths.items(), _WIDTHS, strict=False):
        color = ArmStyle.of(name).color
        time = plant.dt * np.arange(len(path.states))
        true, estimated = (np.abs(x @ plant.box_rows.T).max(axis=1) for x in (path.states, path.estimates))
        (handles[name],) = axis.plot(time, true, color=color, lw=width)
        (handles[f"{name}, estimate"],) = axis.plot(time, estimated, color=_dark(color), lw=1.1, ls=":", zorder=3)
        if (true > 1.0).any():
            crosses = axis.plot(time[true > 1.0], true[true > 1.0], "x", color=_INK, ms=4.5, mew=1.0, zorder=4)
    handles["limit"] = axis.axhline(1.0, **_LIMIT)
    if crosses:
        handles["violation of the true state"] = crosses[0]
    label(axis, "", "largest |c$_j$ x|", "First evaluation episode of the first run")
    axis.set_ylim(0.0, max(1.12, axis.get_ylim()[1]))
    return handles


def _dark(color: str) -> tuple[float, ...]:
    """Returns a color that is visible on a line of the given color."""
    return tuple(0.5 * part for part in to_rgb(color))


def _draw_input(axis: Axes, paths: dict[str, Trajectory], plant: LinearPlant, i: int) -> dict[str, Artist]:
    """Draws one input of all arms, and what was proposed in its place."""
    handles: dict[str, Artist] = {}
    for (name, path), width in zip(paths.items(), _WIDTHS, strict=False):
        style = ArmStyle.of(name)
        edges = plant.dt * np.arange(len(path.inputs) + 1)
        axis.stairs(path.inputs[:, i], edges, baseline=None, color=style.color, lw=width)
        changed = (path.inputs != path.proposed).any(axis=1)
        if changed.any():
            middle = edges[:-1][changed] + 0.5 * plant.dt
            axis.vlines(
                middle, path.inputs[changed, i], path.proposed[changed, i], color=style.color, lw=0.7, alpha=0.6
            )
            axis.plot(middle, path.proposed[changed, i], ".", color=_INK, ms=4.0)
            handles["proposed, but overridden"] = Line2D([], [], ls="none", marker=".", color=_INK)
    limit = float(np.atleast_1d(plant.u_max)[i])
    for end in (-limit, limit):
        axis.axhline(end, **_LIMIT)
    axis.set_ylim(-1.15 * limit, 1.15 * limit)
    label(
        axis,
        "",
        with_unit(f"{plant.input_names[i]}\n" if plant.input_units[i] else plant.input_names[i], plant.input_units[i]),
    )
    return handles


def _events(paths: dict[str, Trajectory], plant: LinearPlant) -> dict[str, tuple[np.ndarray, str]]:
    """Returns times [s] and color of each kind of event by name, from below."""
    longest = max(paths, key=lambda name: len(paths[name].arrivals))
    events: dict[str, tuple[np.ndarray, str]] = {}
    for name, path in paths.items():
        count = len(path.arrivals)
        # With common random numbers packets arrive alike in all arms as a rule, and are shown once.
        if name == longest or not np.array_equal(path.arrivals, paths[longest].arrivals[:count]):
            row = "packet arrivals" if name == longest else f"packet arrivals, {name}"
            events[row] = plant.dt * (1.0 + np.flatnonzero(path.arrivals)), _INK
    for name, path in paths.items():
        mode = Arm.of(name).mode
        if mode is not None:
            row = f"would override, {name}" if mode == "monitor" else "interventions"
            events[row] = plant.dt * (0.5 + np.flatnonzero(path.intervened)), ArmStyle.of(name).color
    return events


def _draw_events(axis: Axes, events: dict[str, tuple[np.ndarray, str]]) -> None:
    """Draws a row of ticks per kind of event."""
    for row, (times, color) in enumerate(events.values()):
        axis.vlines(times, row - 0.36, row + 0.36, color=color, lw=1.2)
    axis.set_yticks(range(len(events)), [f"{name} ({len(times):,})" for name, (times, _) in events.items()])
    axis.set_ylim(-0.6, len(events) - 0.4)
    axis.tick_params(axis="y", length=0)
    axis.grid(False)
