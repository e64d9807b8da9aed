"""Continuous-time plants as a controller with zero-order hold sees them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.truncated_gaussian import chi2_quantile


def zero_order_hold(A: np.ndarray, B: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the matrices of x+ = A x + B u for x' = A x + B u with u held constant over each step, exactly.

    Args:
        A: Continuous-time state matrix, shape (n, n) [1/s].
        B: Continuous-time input matrix, shape (n, m).
        dt: Duration of a step [s].
    """
    from scipy.signal import cont2discrete  # takes long to import

    n, m = B.shape
    sampled: Any = cont2discrete((A, B, np.eye(n), np.zeros((n, m))), dt, method="zoh")
    return sampled[0], sampled[1]


def sampled_plant(
    A: np.ndarray,
    B: np.ndarray,
    H: np.ndarray,
    half_widths: np.ndarray,
    u_max: float,
    dt: float,
    noise_fractions: tuple[float, float],
    arguments: dict[str, Any],
) -> LinearPlant:
    """Returns a plant held constant over each step, with noise bounded by fractions of the box's half-widths.

    Args:
        A: Continuous-time state matrix, shape (n, n) [1/s].
        B: Continuous-time input matrix, shape (n, m).
        H: Output matrix, shape (p, n).
        half_widths: Of the safe box, shape (n,).
        u_max: Limit of every input.
        dt: Duration of a step [s].
        noise_fractions: Bounds of process noise and of sensor noise, as fractions of the half-widths.
        arguments: Other arguments of `LinearPlant`, which take precedence.
    """
    n = len(A)
    sampled_A, sampled_B = zero_order_hold(A, B, dt)
    disturbance, sensor = noise_fractions
    delta = arguments.get("delta", 0.05)
    outputs = np.abs(H) @ half_widths
    defaults = {
        "gamma": 0.0,
        "process_noise_cov": np.diag((disturbance * half_widths) ** 2) / chi2_quantile(1.0 - delta, n),
        "measurement_noise_cov": np.diag((sensor * outputs) ** 2) / chi2_quantile(1.0 - delta, len(H)),
        "initial_cov": (sensor * half_widths.min()) ** 2 / chi2_quantile(1.0 - delta, n) * np.eye(n),
    }
    common = {"A": sampled_A, "B": sampled_B, "C": np.diag(1.0 / half_widths), "H": H, "u_max": u_max, "dt": dt}
    return LinearPlant(**(common | defaults | arguments))
