"""Shadows of the safe set and of the safe box on the plane of two states."""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space, orth
from scipy.spatial import ConvexHull, HalfspaceIntersection

# Directions this much shorter than the others are none.
FLAT = 1e-9


def shadow_of_ellipsoid(shape: np.ndarray, plane: tuple[int, int], points: int = 361) -> np.ndarray:
    """Returns the outline of the shadow of {x : x' shape^-1 x <= 1} on two coordinates, shape (points, 2).

    The shadow of an ellipsoid is the ellipse whose shape is the two coordinates' block.

    Args:
        shape: Shape (n, n), positive definite.
        plane: The coordinates.
        points: How many.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return (np.linalg.cholesky(shape[np.ix_(plane, plane)]) @ circle).T


def shadow_of_box(rows: np.ndarray, plane: tuple[int, int]) -> np.ndarray | None:
    """Returns the closed outline of the shadow of {x : |c_j x| <= 1}, shape (corners + 1, 2); None if it is unbounded.

    Args:
        rows: c_j, shape (k, n).
        plane: The coordinates.
    """
    pick = np.eye(rows.shape[1])[list(plane)]
    free = null_space(rows)
    if free.size and np.abs(pick @ free).max() > FLAT:
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
