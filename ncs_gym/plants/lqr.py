"""The linear-quadratic regulator, which tells what estimation errors cost and where searches for gains begin."""

from __future__ import annotations

import numpy as np


def lqr_gain(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, N: np.ndarray | None = None
) -> np.ndarray | None:
    """Returns K, shape (m, n), of u = K x that minimizes the sum of x'Qx + u'Ru + 2 x'Nu; N is 0 by default.

    None where the Riccati equation has no solution that scipy finds.
    """
    from scipy.linalg import solve_discrete_are  # takes long to import

    try:
        P = solve_discrete_are(A, B, Q, R, s=N)
        answer = B.T @ P @ A if N is None else B.T @ P @ A + N.T
        gain = -np.linalg.solve(R + B.T @ P @ B, answer)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return gain if np.isfinite(gain).all() else None


def regulator_gain(A: np.ndarray, B: np.ndarray, effort: float, decay: float) -> np.ndarray | None:
    """Returns K, shape (m, n), of u = K x that minimizes the sum of (|x|^2 + effort |u|^2) / decay^k.

    The closed loop's eigenvalues are smaller than sqrt(decay).

    Args:
        A: Shape (n, n), in coordinates where |x| is the size of the state.
        B: Shape (n, m), in coordinates where |u| is the size of the input.
        effort: Weight of the inputs.
        decay: In (0, 1].

    Returns:
        The gain; None where the Riccati equation has no solution that scipy finds.
    """
    return lqr_gain(A / np.sqrt(decay), B / np.sqrt(decay), np.eye(len(A)), effort * np.eye(B.shape[1]))
