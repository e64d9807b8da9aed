"""Which points lie outside the sum of two ellipsoids, for many points at once."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from ncs_gym.ellipsoid import sum_gauge

# Halvings of the share nu after which the point at which both parts are equally long is known to float64.
HALVINGS = 60


def outside_sum(points: np.ndarray, first: np.ndarray, second: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns which points lie outside E(P1) + E(P2) by more than a tolerance, bool of shape (k,); NaN lies outside.

    Any share nu splits r into P1 w / nu + P2 w / (1-nu) with w = (P1/nu + P2/(1-nu))^-1 r. If both parts lie in their
    ellipsoids, r lies in the sum; if r'w > 1, it does not (see `sum_gauge`). r'w is concave in nu, and its slope is the
    difference of the parts' squared gauges, so that halving finds a share that settles the matter.

    Args:
        points: r, shape (k, p).
        first: P1, shape (p, p), positive semidefinite.
        second: P2, shape (p, p), positive definite; where it is not, in float64, each point takes much longer.
        tolerance: Relative.
    """
    try:
        root = np.linalg.cholesky(second)
    except np.linalg.LinAlgError:
        return np.array([sum_gauge(point, first, second) > 1.0 + tolerance for point in points], np.bool_)
    half = solve_triangular(root, 0.5 * (first + first.T), lower=True)
    values, axes = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
    values = np.maximum(values, 0.0)[:, None]
    with np.errstate(invalid="ignore", over="ignore"):
        squares = np.square(axes.T @ solve_triangular(root, points.T, lower=True, check_finite=False))
    outside, limit = np.ones(len(points), np.bool_), (1.0 + tolerance) ** 2
    unsettled, low, high = np.arange(len(points)), np.zeros(len(points)), np.ones(len(points))
    for _ in range(HALVINGS):
        share = 0.5 * (low + high)
        weights = share * (1.0 - share) / (values * (1.0 - share) + share)
        form = (squares * weights).sum(axis=0)
        parts = (
            (squares * values * (weights / share) ** 2).sum(axis=0),
            (squares * (weights / (1.0 - share)) ** 2).sum(0),
        )
        outside[unsettled] = ~(form <= limit)
        rest = (form <= limit) & (np.maximum(*parts) > limit)
        if not rest.any():
            break
        rises = parts[0] > parts[1]
        low, high = np.where(rises, share, low)[rest], np.where(rises, high, share)[rest]
        unsettled, squares = unsettled[rest], squares[:, rest]
    return outside
