"""Points of a box inside an ellipsoid, and the diagonal part of one."""

from __future__ import annotations

import numpy as np

from ncs_gym.uncertainty.ellipsoid import Ellipsoid


def sample_box(bound: Ellipsoid, rng: np.random.Generator, count: int | None = None) -> np.ndarray:
    """Returns points that are uniform in the box inside an ellipsoid along its principal axes.

    For a bound given by half-widths that is the box of these half-widths.

    Args:
        bound: The ellipsoid.
        rng: Source of randomness.
        count: Number of points; None for a single one.

    Returns:
        Shape (n,), or (n, count).
    """
    axes = bound.factor * bound.drawn_axes / np.sqrt(np.count_nonzero(bound.drawn_axes))
    return axes @ rng.uniform(-1.0, 1.0, bound.dim if count is None else (bound.dim, count))


def diagonal_inside(bound: Ellipsoid) -> np.ndarray:
    """Returns the diagonal shape of an ellipsoid inside one, shape (n, n): that itself if its axes are the coordinates.

    It is j diag(P), j the smallest eigenvalue of P in units in which its diagonal is 1.
    """
    variances = np.diag(bound.shape_matrix)
    kept = variances > 0.0
    if not kept.any() or np.array_equal(bound.shape_matrix, np.diag(variances)):
        return bound.shape_matrix
    scale = np.sqrt(variances[kept])
    smallest = np.linalg.eigvalsh(bound.shape_matrix[np.ix_(kept, kept)] / np.outer(scale, scale))[0]
    return max(float(smallest), 0.0) * np.diag(variances)
