"""The linear-quadratic regulator, which tells what estimation errors cost and where searches for gains begin."""

from __future__ import annotations

import numpy as np


def lqr_gain(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, N: np.ndarray | None = None
) -> np.ndarray | None:
    """Returns K, shape (m, n), of u = K x that minimizes the sum of x'Qx + u'Ru + 2 x'Nu; N is 0 by default.

    It is sought in units in which the diagonals of Q and R are about 1 where they are not 0. None where the Riccati
    equation has no solution that scipy finds.
    """
    from scipy.linalg import solve_discrete_are  # takes long to import

    sizes = [np.where(np.diag(weight) > 0.0, np.diag(weight), 1.0) for weight in (Q, R)]
    x, u = (np.exp2(-np.round(0.5 * np.log2(size))) for size in sizes)
    A, B, Q, R = A * x / x[:, None], B * u / x[:, None], Q * np.outer(x, x), R * np.outer(u, u)
    crossed = np.zeros(B.shape) if N is None else N * np.outer(x, u)
    try:
        P = solve_discrete_are(A, B, Q, R, s=crossed)
        gain = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + crossed.T)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return gain * u[:, None] / x if np.isfinite(gain).all() else None


def regulator_gain(A: np.ndarray, B: np.ndarray, effort: float, decay: float) -> np.ndarray | None:
    """Returns K, shape (m, n), of u = K x that minimizes the sum of (|x|^2 + effort |u|^2) / decay^k; None as above.

    The closed loop's eigenvalues are smaller than sqrt(decay), in (0, 1].
    """
    return lqr_gain(A / np.sqrt(decay), B / np.sqrt(decay), np.eye(len(A)), effort * np.eye(B.shape[1]))
