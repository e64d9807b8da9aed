"""Which points lie outside the sum of two ellipsoids, for many points at once."""

from __future__ import annotations

import numpy as np

from ncs_gym.uncertainty.ellipsoid import sum_gauge

# Halvings of the multiplier nu after which the point at which both parts are equally long is known to float64.
HALVINGS = 60


def outside_sum(points: np.ndarray, first: np.ndarray, second: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns which points lie outside E(P1) + E(P2) by more than a tolerance, bool of shape (k,); NaN lies outside.

    Args:
        points: r, shape (k, p).
        first: P1, shape (p, p), positive semidefinite.
        second: P2, shape (p, p), positive definite; where it is not, in float64, each point takes much longer.
        tolerance: Relative.
    """
    axes, values = common_axes(first, second)
    if not np.isfinite(axes).all():
        return np.array([sum_gauge(point, first, second) > 1.0 + tolerance for point in points], np.bool_)
    with np.errstate(invalid="ignore", over="ignore"):
        squares = np.square(axes @ points.T)
    return outside_sum_in_axes(squares, values[:, None], tolerance)


def outside_sum_in_axes(squares: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns which points lie outside E(P1) + E(P2), in axes in which both are diagonal, bool of shape (k,).

    Any multiplier nu splits r into P1 w / nu + P2 w / (1-nu) with w = (P1/nu + P2/(1-nu))^-1 r. If both parts lie in
    their ellipsoids, r lies in the sum; if r'w > 1, it does not (see `sum_gauge`). r'w is concave in nu, and its slope
    is the difference of the parts' squared gauges, so that halving finds a multiplier that decides.

    Args:
        squares: Squared coordinates of the points in the axes F of `common_axes`, shape (p, k); NaN lies outside.
        values: Diagonals of F P1 F' where F P2 F' = I, shape (p, k) or (p, 1).
        tolerance: Relative.
    """
    count, limit = squares.shape[1], (1.0 + tolerance) ** 2
    values = np.broadcast_to(values, squares.shape)
    outside, undecided = np.ones(count, np.bool_), np.arange(count)
    low, high = np.zeros(count), np.ones(count)
    for _ in range(HALVINGS):
        nu = 0.5 * (low + high)
        weights = nu * (1.0 - nu) / (values * (1.0 - nu) + nu)
        form = (squares * weights).sum(axis=0)
        in_first = (squares * values * (weights / nu) ** 2).sum(axis=0)
        in_second = (squares * (weights / (1.0 - nu)) ** 2).sum(axis=0)
        outside[undecided] = ~(form <= limit)
        rest = (form <= limit) & (np.maximum(in_first, in_second) > limit)
        if not rest.any():
            break
        rises = in_first > in_second
        low, high = np.where(rises, nu, low)[rest], np.where(rises, high, nu)[rest]
        undecided, squares, values = undecided[rest], squares[:, rest], values[:, rest]
    return outside


def common_axes(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns F, shape (p, p), and j >= 0, shape (p,), with F P1 F' = diag(j) and F P2 F' = I; NaN if P2 is flat."""
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(second))
    except np.linalg.LinAlgError:
        return np.full_like(second, np.nan), np.full(len(second), np.nan)
    values, axes = np.linalg.eigh(inverse @ (0.5 * (first + first.T)) @ inverse.T)
    return axes.T @ inverse, np.maximum(values, 0.0)
