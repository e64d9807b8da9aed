"""Trajectories in the plane of two states, with safe set and safe box."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from scipy.linalg import null_space, orth
from scipy.spatial import ConvexHull, HalfspaceIntersection

from experiments.plots.figure_style import STYLE, ArmStyle, CaptionedFigure, label, legend_below, with_unit
from experiments.runs.arms import ResultsByArm
from ncs_gym import LinearPlant
from shields import Certificate

# Largest number of panels side by side.
_COLUMNS = 4
# The view is the projection of box and safe set, enlarged by this factor; states farther away are left out.
_VIEW = 3.0
_INK = "#222222"
# Directions whose projection is shorter than this lie across the plane.
_FLAT = 1e-9


def phase_figure(plant: LinearPlant, certificate: Certificate, arms: ResultsByArm) -> CaptionedFigure:
    """Returns two states of the first evaluation episode of each run, a panel per arm, with safe box and safe set."""
    plane = _plane(certificate, arms)
    rows = -(-len(arms) // _COLUMNS)
    columns = -(-len(arms) // rows)
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((min(11.0, 1.4 + 3.2 * columns), 0.9 + 2.9 * rows), _caption(plant, certificate, arms))
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


def _caption(plant: LinearPlant, certificate: Certificate, arms: ResultsByArm) -> str:
    """Returns the caption: what is shown, and what is left out."""
    plane = _plane(certificate, arms)
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
    """Draws one trajectory, its start and its violating states."""
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
    """Draws safe set and safe box, or their projections."""
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
