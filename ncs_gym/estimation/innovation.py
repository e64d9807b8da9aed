"""The innovation test: whether an error and a noise within their bounds explain a residual.

While the assumptions hold, a residual r = y - H x_hat lies in the Minkowski sum E(H Sigma_k H') + E(N).
"""

from __future__ import annotations

import numpy as np

from ncs_gym.plants.linear_plant import FLAT_INFLATION

# An innovation this far beyond its exact bound counts as rounding, not as an alarm.
ALARM_TOLERANCE = 1e-9
# Up to this condition number, in the norm of Frobenius, an inverse says which residuals are possible to within 1e-3.
MAX_CONDITION_NUMBER = 1e7
# Halvings of the multiplier nu after which the point at which both parts are equally long is known to float64.
HALVINGS = 60


def quick_test(spread: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Returns W, shape (p, p), of the quick test, given H Sigma_k H' and N: a residual with r'Wr <= 1 is possible.

    The ellipsoid of shape H Sigma_k H' + N lies inside the Minkowski sum. Where its inverse would be too inexact, W is
    infinite on the diagonal: no residual passes then.
    """
    bound = spread + noise
    extent = np.sqrt(bound.diagonal())
    units = extent[:, None] * extent
    try:
        scaled = bound / units  # in units of its own
        inverse = np.linalg.inv(scaled)
        is_sure = np.vdot(scaled, scaled) * np.vdot(inverse, inverse) <= MAX_CONDITION_NUMBER**2  # NaN is not
    except np.linalg.LinAlgError:
        is_sure = False
    return inverse / units if is_sure else np.diag(np.full(len(bound), np.inf))


def outside_sum(points: np.ndarray, first: np.ndarray, second: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns which points, (k, p), lie outside E(P1) + E(P2), P2 > 0, by more than a relative tolerance, (k,)."""
    axes, values = common_axes(first, second)
    return outside_sum_in_axes(np.square(axes @ points.T), values[:, None], tolerance)


def outside_sum_in_axes(squares: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns which points lie outside E(P1) + E(P2), in axes in which both are diagonal, bool of shape (k,).

    Any multiplier nu splits r into P1 w / nu + P2 w / (1-nu) with w = (P1/nu + P2/(1-nu))^-1 r. If both parts lie in
    their ellipsoids, r lies in the sum; if r'w > 1, it does not. r'w is concave in nu, and its slope is the difference
    of the parts' squared gauges, so that halving finds a multiplier that decides.

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
    """Returns F, shape (p, p), and j >= 0, shape (p,), with F P1 F' = diag(j) and F P2 F' = I.

    Where P2 is flat in float64 it is a little larger: what is then still outside of the sum is outside.
    """
    try:
        root = np.linalg.cholesky(second)
    except np.linalg.LinAlgError:
        root = np.linalg.cholesky(second + FLAT_INFLATION * np.diag(np.diag(first + second)))
    inverse = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse @ (0.5 * (first + first.T)) @ inverse.T)
    return axes.T @ inverse, np.maximum(values, 0.0)
