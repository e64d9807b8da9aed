"""Models in continuous time, sampled exactly."""

from __future__ import annotations

import numpy as np

from ncs_gym import exact

# Durations of steps that differ by less than this are the same.
SAME_STEP = 1e-9


def zero_order_hold(A: np.ndarray, B: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the matrices of x+ = A x + B u for x' = A x + B u with u held constant over each step.

    Every entry is rounded once, so that it is the same on every machine.

    Args:
        A: Continuous-time state matrix, shape (n, n) [1/s].
        B: Continuous-time input matrix, shape (n, m).
        dt: Duration of a step [s].

    Raises:
        ValueError: If an entry is too large for a float64.
    """
    n, m = B.shape
    try:
        sampled = exact.exponential(np.block([[A, B], [np.zeros((m, n + m))]]), dt)
    except OverflowError as error:
        raise ValueError(f"the model grows beyond all numbers within a step of {dt:g} s: give a smaller dt") from error
    return sampled[:n, :n], sampled[:n, n:]
