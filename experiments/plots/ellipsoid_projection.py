"""Projections of the safe set and of the safe box on the plane of two states."""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space, orth
from scipy.spatial import ConvexHull, HalfspaceIntersection

# Directions whose projection is shorter than this lie across the plane.
_FLAT = 1e-9


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
