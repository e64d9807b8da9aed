"""Which points lie outside the sum of two ellipsoids, for many points at once."""

from __future__ import annotations

import numpy as np

from ncs_gym.uncertainty.ellipsoid import sum_gauge

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
    turn, values = common_axes(first, second)
    if not np.isfinite(turn).all():
        return np.array([sum_gauge(point, first, second) > 1.0 + tolerance for point in points], np.bool_)
    values = values[:, None]
    with np.errstate(invalid="ignore", over="ignore"):
        squares = np.square(turn @ points.T)
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


def common_axes(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns F, shape (p, p), and j >= 0, shape (p,), with F P1 F' = diag(j) and F P2 F' = I; NaN if P2 is flat."""
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(second))
    except np.linalg.LinAlgError:
        return np.full_like(second, np.nan), np.full(len(second), np.nan)
    values, axes = np.linalg.eigh(inverse @ (0.5 * (first + first.T)) @ inverse.T)
    return axes.T @ inverse, np.maximum(values, 0.0)
