"""The figures of a comparison: cost and return, training curves, one episode over time, and the phase plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy.linalg import null_space, orth
from scipy.spatial import ConvexHull, HalfspaceIntersection

from agents.results import Trajectory
from experiments.plots.figure_style import STYLE, ArmStyle, CaptionedFigure, label, legend_below, thousands, with_unit
from experiments.runs.arms import Arm, ResultsByArm
from experiments.runs.training_run import RunResult
from ncs_gym import LinearPlant
from shields import Certificate

_INK = "#222222"


def comparison_figures(
    plant: LinearPlant, certificate: Certificate, summary: dict[str, Any], results: ResultsByArm
) -> dict[str, tuple[str, bytes]]:
    """Returns caption and PNG file of every figure by name, what the findings are about first.

    Args:
        plant: Plant of the environment.
        certificate: Certificate of the safe set.
        summary: Content of summary.json; its arms are shown in its order.
        results: Results of the runs of every arm.
    """
    arms = {name: results[name] for name in summary["arms"]}
    trained = {name: runs for name, runs in arms.items() if runs[0].history}
    figures = {"scatter": scatter_figure(summary["arms"], arms)}
    if trained:
        figures["training"] = training_figure(trained)
    figures["episode"] = episode_figure(plant, arms)
    if plant.n > 1:  # a single state has no phase plane
        figures["phase"] = phase_figure(plant, certificate, arms)
    return {name: (figure.caption, figure.png) for name, figure in figures.items()}


# Marker sizes of the first and of the last arm [points]: where arms coincide, the lower ones are visible.
_SIZES = (12.0, 7.5)


def scatter_figure(summary: dict[str, dict[str, Any]], arms: ResultsByArm) -> CaptionedFigure:
    """Returns mean return against violating episodes.

    Args:
        summary: Summary of each arm.
        arms: Results of each arm.
    """
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((7.5, 4.4), _scatter_caption(arms))
        axis = figure.subplots()
        sizes = np.linspace(*_SIZES, len(arms))
        styles = {name: replace(ArmStyle.of(name), size=float(size)) for name, size in zip(arms, sizes, strict=True)}
        for name, results in arms.items():
            rates = [100.0 * float(np.mean([e.violation_steps > 0 for e in result.episodes])) for result in results]
            _draw_arm(axis, styles[name], summary[name], rates)
        label(axis, "violating evaluation episodes [%]", "mean return per episode")
        _scale_of_costs(axis)
        legend_below(figure, {name: style.handle(line=False, points=True) for name, style in styles.items()})
        return figure


def _scatter_caption(arms: ResultsByArm) -> str:
    runs = max(len(results) for results in arms.values())
    text = "Cost and return in evaluation, better to the upper left."
    if runs > 1:
        text += (
            f" Small dots are runs, markers the mean of {runs} of them; vertical bars are Student's 95 % interval of"
            " the mean return over runs,"
        )
    else:
        text += " A marker is one run, so the return has no interval;"
    text += (
        " horizontal bars Clopper and Pearson's 95 % interval of violating episodes given the trained"
        " agents. Markers differ in size only to show where they coincide. Violations are those of the true state,"
        " returns the environment's own, without penalties."
    )
    lengths = {episode.steps for results in arms.values() for result in results for episode in result.episodes}
    if len(lengths) > 1:
        text += " Episodes that end at a violation are shorter: their returns sum fewer steps."
    return text


def _draw_arm(axis: Axes, style: ArmStyle, arm: dict[str, Any], rates: list[float]) -> None:
    """Draws an arm's runs and mean, with the intervals that there are.

    Args:
        axis: Axis to draw on.
        style: Style of the arm.
        arm: Summary of the arm.
        rates: Violating episodes of each run [%].
    """
    mean, rate = arm["eval_return_mean"], 100.0 * arm["eval_violation_rate"]
    if len(rates) > 1:
        axis.plot(rates, arm["eval_return_by_run"], "o", ms=4.5, mfc=style.color, mec="white", mew=0.6, zorder=2.5)
    if arm["eval_return_ci95"] is not None:
        axis.plot([rate, rate], arm["eval_return_ci95"], "-_", color=style.color, lw=1.3, ms=9.0, mew=1.3)
    bounds = [100.0 * bound for bound in arm["eval_violation_rate_ci95"]]
    axis.plot(bounds, [mean, mean], "-|", color=style.color, lw=1.3, ms=9.0, mew=1.3)
    axis.plot(rate, mean, ls="none", **style.points, zorder=3)


def _scale_of_costs(axis: Axes) -> None:
    """Lets the axis of costs begin at zero, with space for markers there."""
    high = axis.dataLim.x1 if axis.dataLim.x1 > 0.0 else 1.0
    axis.set_xlim(-0.04 * high, 1.06 * high)
    axis.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    axis.xaxis.set_major_formatter(thousands)
    axis.yaxis.set_major_formatter(thousands)


# Curves of fewer points show each point.
_FEW_POINTS = 5
# The rate of interventions is averaged over this many steps, an episode of 200 in each of 64 environments: it rises and
# falls with the episodes, which start together.
_RATE_WINDOW = 64 * 200


def training_figure(arms: ResultsByArm) -> CaptionedFigure:
    """Returns return, violating steps so far and intervention rate against training steps, bands over runs.

    Without an arm that watches for unsafe actions there is no third panel.
    """
    watching = [name for name in arms if Arm.of(name).mode is not None]
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((11.0, 3.9), _training_caption(arms))
        axes = figure.subplots(1, 3 if watching else 2)
        for name, results in arms.items():
            steps = _common_steps(results)
            style = ArmStyle.of(name)
            _draw_curve(axes[0], steps, _on(steps, results, "episode_return"), style)
            violations = _on(steps, results, "violation_steps")
            # Before the first step nothing has happened: true, and a curve even where the history is one point.
            _draw_curve(axes[1], np.array([0, *steps]), np.pad(violations, ((0, 0), (1, 0))), style)
            if name in watching:
                _draw_curve(axes[2], steps, 100.0 * _rates(steps, _on(steps, results, "interventions")), style)
        label(axes[0], "training steps", "mean return of recent episodes", "Return")
        label(axes[1], "training steps", "violating steps so far", "Violations of the true state")
        if watching:
            title = "Interventions" + " (monitor's: hypothetical)" * ("monitor" in arms)
            label(axes[2], "training steps", "actions overridden [%]", title)
        last = max((point.steps for runs in arms.values() for run in runs for point in run.history), default=1)
        for axis in axes:
            _scale_of_training(axis, last, from_zero=axis is not axes[0])
        legend_below(figure, _training_handles(arms))
        return figure


def _training_caption(arms: ResultsByArm) -> str:
    runs = max(len(results) for results in arms.values())
    band = (
        f"Lines are means over {runs} runs per arm, bands reach from the lowest to the highest run."
        if runs > 1
        else "One run per arm, so there is no band."
    )
    text = f"Training. {band} The return begins where every run has finished an episode."
    if any(Arm.of(name).mode is not None for name in arms):
        text += f" Interventions are rates over the last {_RATE_WINDOW:,} steps (over all, before there are as many)."
    if "monitor" in arms:
        text += " The monitor's are what the shield would have overridden; its agent is the unshielded one."
    penalized = [name for name in arms if Arm.of(name).penalizes_interventions or Arm.of(name).penalizes_violations]
    if penalized:
        text += f" The return in training contains the penalties that {' and '.join(penalized)} get."
    return text


def _common_steps(results: Sequence[RunResult]) -> np.ndarray:
    """Returns steps that all runs of an arm have reached, shape (points,): those of the run with the shortest history.

    Runs of one arm may note their totals at different steps; others are interpolated there.
    """
    steps = [np.array([point.steps for point in result.history], dtype=float) for result in results]
    last = min((run[-1] for run in steps if len(run)), default=0.0)
    shortest = min(steps, key=len)
    return shortest[shortest <= last]


def _rates(steps: np.ndarray, totals: np.ndarray) -> np.ndarray:
    """Returns events per step over the last `_RATE_WINDOW` steps, shape (runs, points).

    Args:
        steps: Shape (points,).
        totals: Events so far, shape (runs, points).
    """
    past = np.maximum(steps - _RATE_WINDOW, 0.0)
    before = np.array([np.interp(past, [0.0, *steps], [0.0, *row]) for row in totals])
    return (totals - before) / (steps - past)


def _on(steps: np.ndarray, results: Sequence[RunResult], name: str) -> np.ndarray:
    """Returns one quantity of the histories at some steps, shape (runs, points)."""
    rows = []
    for result in results:
        own = [point.steps for point in result.history]
        values = [float(getattr(point, name)) for point in result.history]
        rows.append(np.interp(steps, own, values) if own else np.full(len(steps), np.nan))
    return np.array(rows)


def _draw_curve(axis: Axes, steps: np.ndarray, values: np.ndarray, style: ArmStyle) -> None:
    if len(values) > 1:
        low, high = values.min(axis=0), values.max(axis=0)
        if len(steps) < _FEW_POINTS:
            axis.vlines(steps, low, high, color=style.color, lw=1.5, alpha=0.6)
        axis.fill_between(steps, low, high, color=style.color, alpha=0.16, lw=0.0)
    points: dict[str, Any] = style.points if len(steps) < _FEW_POINTS else {}
    axis.plot(steps, values.mean(axis=0), lw=1.9, **style.line, **points)


def _scale_of_training(axis: Axes, last: float, from_zero: bool) -> None:
    axis.set_xlim(0.0, 1.04 * last)
    if from_zero:
        # A curve at zero keeps its width above the axis.
        high = axis.dataLim.y1 if axis.dataLim.y1 > 0.0 else 1.0
        axis.set_ylim(-0.02 * high, 1.06 * high)
    elif not np.isfinite(axis.dataLim.y1):
        axis.set_yticks([])
        axis.text(0.5, 0.5, "no episode was finished", ha="center", color="#555555", transform=axis.transAxes)
    for side in (axis.xaxis, axis.yaxis):
        if side is axis.xaxis or np.isfinite(axis.dataLim.y1):
            side.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        side.set_major_formatter(thousands)


def _training_handles(arms: ResultsByArm) -> dict[str, Artist]:
    points = any(len(_common_steps(results)) < _FEW_POINTS for results in arms.values())
    handles: dict[str, Artist] = {name: ArmStyle.of(name).handle(points=points) for name in arms}
    if any(len(results) > 1 for results in arms.values()):
        handles["lowest to highest run"] = Patch(color="#555555", alpha=0.2, lw=0.0)
    return handles


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
        figure = CaptionedFigure((11.0, 1.2 + 1.45 * sum(heights)), _episode_caption(arms))
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


def _episode_caption(arms: ResultsByArm) -> str:
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
        darker = [0.5 * part for part in to_rgb(color)]  # seen on a line of the color itself
        time = plant.dt * np.arange(len(path.states))
        true, estimated = (np.abs(x @ plant.box_rows.T).max(axis=1) for x in (path.states, path.estimates))
        (handles[name],) = axis.plot(time, true, color=color, lw=width)
        (handles[f"{name}, estimate"],) = axis.plot(time, estimated, color=darker, lw=1.1, ls=":", zorder=3)
        if (true > 1.0).any():
            crosses = axis.plot(time[true > 1.0], true[true > 1.0], "x", color=_INK, ms=4.5, mew=1.0, zorder=4)
    handles["limit"] = axis.axhline(1.0, **_LIMIT)
    if crosses:
        handles["violation of the true state"] = crosses[0]
    label(axis, "", "largest |c$_j$ x|", "First evaluation episode of the first run")
    axis.set_ylim(0.0, max(1.12, axis.get_ylim()[1]))
    return handles


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
    unit = plant.input_units[i]
    label(axis, "", with_unit(plant.input_names[i] + "\n" * bool(unit), unit))
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
    for row, (times, color) in enumerate(events.values()):
        axis.vlines(times, row - 0.36, row + 0.36, color=color, lw=1.2)
    axis.set_yticks(range(len(events)), [f"{name} ({len(times):,})" for name, (times, _) in events.items()])
    axis.set_ylim(-0.6, len(events) - 0.4)
    axis.tick_params(axis="y", length=0)
    axis.grid(False)


# Largest number of panels side by side.
_COLUMNS = 4
# The view is the projection of box and safe set, enlarged by this factor; states farther away are left out.
_VIEW = 3.0
# Directions whose projection is shorter than this lie across the plane.
_FLAT = 1e-9


def phase_figure(plant: LinearPlant, certificate: Certificate, arms: ResultsByArm) -> CaptionedFigure:
    """Returns two states of the first evaluation episode of each run, a panel per arm, with safe box and safe set."""
    plane = _plane(certificate, arms)
    rows = -(-len(arms) // _COLUMNS)
    columns = -(-len(arms) // rows)
    with matplotlib.rc_context(STYLE):
        caption = _phase_caption(plant, certificate, arms, plane)
        figure = CaptionedFigure((min(11.0, 1.4 + 3.2 * columns), 0.9 + 2.9 * rows), caption)
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        handles: dict[str, Artist] = {}
        for panel, (name, results) in zip(panels.flat, arms.items(), strict=False):
            handles |= _draw_sets(panel, plant, certificate, plane)
            color, alpha = ArmStyle.of(name).color, max(0.8 - 0.05 * len(results), 0.3)  # many paths stay apart
            for result in results:
                handles |= _draw_path(panel, plant, result.trajectory.states, plane, color, alpha)
            panel.set_title(name)
        for panel in panels.flat[len(arms) :]:
            panel.set_visible(False)
        _view(panels[0, 0], plant, certificate, arms, plane)
        _name_axes(panels, plant, plane, len(arms))
        legend_below(figure, handles)
        return figure


def _phase_caption(plant: LinearPlant, certificate: Certificate, arms: ResultsByArm, plane: tuple[int, int]) -> str:
    text = "Phase plane: true states of the first evaluation episode of each run, for every arm."
    if plant.n > 2:
        first, second = (plant.state_names[i] for i in plane)
        text += (
            f" Of the {plant.n} states the two that come closest to the boundary of the safe set, {first} and {second};"
            " the curves are the projections of safe set and safe box on their plane, and a state within a projection"
            " may lie outside of the set."
        )
    reach = _reach(plant, certificate, plane)
    if any((np.abs(r.trajectory.states[:, plane]) > reach).any() for results in arms.values() for r in results):
        text += " Some trajectories leave the view."
    return text


def _plane(certificate: Certificate, arms: ResultsByArm) -> tuple[int, int]:
    """Returns the two states that are largest in units of the safe set's extent, in ascending order."""
    states = np.concatenate([result.trajectory.states for results in arms.values() for result in results])
    furthest = (np.abs(states) / np.sqrt(np.diag(certificate.L))).max(axis=0)
    first, second = sorted(np.argsort(-furthest, kind="stable")[:2].tolist())
    return first, second


def _draw_path(
    axis: Axes, plant: LinearPlant, states: np.ndarray, plane: tuple[int, int], color: str, alpha: float
) -> dict[str, Artist]:
    x, y = states[:, plane].T
    axis.plot(x, y, color=color, lw=0.9, alpha=alpha)
    (start,) = axis.plot(x[:1], y[:1], "o", ls="none", ms=5, mfc="white", mec=_INK, mew=1.0)
    handles: dict[str, Artist] = {"start": start}
    outside = plant.constraint_values(states.T).max(axis=0) > 0.0
    if outside.any():
        (cross,) = axis.plot(x[outside], y[outside], "x", color=_INK, ms=4.5, mew=1.0)
        handles["violation of the true state"] = cross
    return handles


def _draw_sets(axis: Axes, plant: LinearPlant, certificate: Certificate, plane: tuple[int, int]) -> dict[str, Artist]:
    prefix = "" if plant.n == 2 else "projection of the "
    (outline,) = axis.plot(*_projected(certificate, plane).T, color=_INK, lw=1.3)
    handles: dict[str, Artist] = {f"{prefix}safe set": outline}
    box = projected_box(plant.box_rows, plane)
    if box is not None:
        (outline,) = axis.plot(*box.T, color=_INK, lw=1.0, ls="--")
        handles[f"{prefix}safe box"] = outline
    return handles


def _reach(plant: LinearPlant, certificate: Certificate, plane: tuple[int, int]) -> np.ndarray:
    """Returns the largest half-widths of the view, shape (2,) [units of the states]."""
    outlines = [_projected(certificate, plane), projected_box(plant.box_rows, plane)]
    return _VIEW * np.max([np.abs(outline).max(axis=0) for outline in outlines if outline is not None], axis=0)


def _view(axis: Axes, plant: LinearPlant, certificate: Certificate, arms: ResultsByArm, plane: tuple[int, int]) -> None:
    """Limits the view to the sets and the trajectories near them."""
    reach = _reach(plant, certificate, plane)
    states = np.concatenate([result.trajectory.states for results in arms.values() for result in results])
    half = np.clip(1.05 * np.abs(states[:, plane]).max(axis=0), 1.08 * reach / _VIEW, reach)
    axis.set_xlim(-half[0], half[0])
    axis.set_ylim(-half[1], half[1])


def _name_axes(panels: Any, plant: LinearPlant, plane: tuple[int, int], count: int) -> None:
    """Labels the outer axes; the lowest panel of a column need not be in the last row."""
    x, y = (with_unit(plant.state_names[i], plant.state_units[i]) for i in plane)
    columns = panels.shape[1]
    for at, panel in enumerate(panels.flat[:count]):
        lowest = at + columns >= count
        label(panel, x if lowest else "", y if at % columns == 0 else "", panel.get_title())
        panel.tick_params(labelbottom=lowest)


def _projected(certificate: Certificate, plane: tuple[int, int]) -> np.ndarray:
    """Returns points around the projection of the safe set onto two states, shape (k, 2); the first one is the last."""
    if certificate.polytope is None:
        return projected_ellipsoid(certificate.L, plane)
    corners = certificate.polytope.outline(plane)
    return np.concatenate([corners, corners[:1]])


def projected_ellipsoid(shape: np.ndarray, plane: tuple[int, int], points: int = 361) -> np.ndarray:
    """Returns the outline of the projection of {x : x' shape^-1 x <= 1} on two coordinates, shape (points, 2).

    The projection of an ellipsoid is the ellipse whose shape is the block of the two coordinates.

    Args:
        shape: Shape of the ellipsoid, positive definite, shape (n, n).
        plane: The two coordinates.
        points: Number of points of the outline.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return (np.linalg.cholesky(shape[np.ix_(plane, plane)]) @ circle).T


def projected_box(rows: np.ndarray, plane: tuple[int, int]) -> np.ndarray | None:
    """Returns the outline of the projection of {x : |c_j x| <= 1}, closed, shape (corners + 1, 2); None if unbounded.

    Args:
        rows: Rows c_j, shape (k, n).
        plane: The two coordinates.
    """
    pick = np.eye(rows.shape[1])[list(plane)]
    free = null_space(rows)
    if free.size and np.abs(pick @ free).max() > _FLAT:
        return None
    # Along unlimited directions the box is a prism over these coordinates, in which it is bounded.
    basis = orth(rows.T)
    walls = rows @ basis
    sides = np.vstack([np.column_stack([sign * walls, -np.ones(len(walls))]) for sign in (1.0, -1.0)])
    if basis.shape[1] == 1:
        return None
    corners = HalfspaceIntersection(sides, np.zeros(basis.shape[1])).intersections @ basis.T @ pick.T
    hull = corners[ConvexHull(corners).vertices]
    return np.vstack([hull, hull[:1]])
