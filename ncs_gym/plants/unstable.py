"""Unstable plants that people control over networks."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import expm

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.truncated_gaussian import chi2_quantile

GRAVITY = 9.81
# Bounds on the noise as shares of the half-widths of the box; no gamma, so that every state has its own scale.
CART_POLE_DISTURBANCE = 1.2e-3
CART_POLE_SENSOR = 1e-4
REACTOR_DISTURBANCE = 5e-3
REACTOR_SENSOR = 1e-3
# The gain of shields.synthesis.max_margin_gain at max_age = 1, in round numbers.
REACTOR_GAIN = ((-0.4, -1.8, -1.0, 0.4), (2.2, 0.0, 1.2, -1.4))


def cart_pole(
    cart_mass: float = 1.0,
    pole_mass: float = 0.1,
    length: float = 0.5,
    dt: float = 0.02,
    full_state: bool = True,
    **bounds: Any,
) -> LinearPlant:
    """Returns an inverted pendulum on a cart, linearized upright, by exact zero-order hold.

    x = (position [m], speed [m/s], angle [rad], angular rate [rad/s]), u the force on the cart [N], |u| <= 10. Safe
    box: 2.4 m, 3 m/s, 0.2 rad, 2 rad/s. The environment simulates the linear equations, which differ from those of a
    pendulum by less than 1 % of gravity's pull at the edge of the box (sin 0.2 = 0.1987).

    Args:
        cart_mass: [kg].
        pole_mass: Of a point mass at the end of a light rod [kg].
        length: Of the rod [m].
        dt: Step [s].
        full_state: Measure all states; False measures position and angle.
        bounds: Other arguments of `LinearPlant`.
    """
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1, 2] = -pole_mass * GRAVITY / cart_mass
    A[3, 2] = (cart_mass + pole_mass) * GRAVITY / (cart_mass * length)
    B = np.array([[0.0], [1.0 / cart_mass], [0.0], [-1.0 / (cart_mass * length)]])
    half_widths = np.array([2.4, 3.0, 0.2, 2.0])
    H = np.eye(4) if full_state else np.eye(4)[[0, 2]]
    names = {
        "state_names": ("position", "speed", "angle", "angular rate"),
        "state_units": ("m", "m/s", "rad", "rad/s"),
        "input_names": ("force",),
        "input_units": ("N",),
    }
    shares = (CART_POLE_DISTURBANCE if full_state else 0.4 * CART_POLE_DISTURBANCE, CART_POLE_SENSOR)
    return _sampled(A, B, H, half_widths, 10.0, dt, shares, names | bounds)


def batch_reactor(dt: float = 0.05, **bounds: Any) -> LinearPlant:
    """Returns the unstable batch reactor of the networked-control literature, by exact zero-order hold.

    Four states, two inputs, two outputs (x1 + x3 - x4 and x2), dimensionless; safe box |x_i| <= 1, |u_i| <= 2.

    Args:
        dt: Step [s].
        bounds: Other arguments of `LinearPlant`.
    """
    A = np.array(
        [
            [1.38, -0.2077, 6.715, -5.676],
            [-0.5814, -4.29, 0.0, 0.675],
            [1.067, 4.273, -6.654, 5.893],
            [0.048, 4.273, 1.343, -2.104],
        ]
    )
    B = np.array([[0.0, 0.0], [5.679, 0.0], [1.136, -3.146], [1.136, 0.0]])
    H = np.array([[1.0, 0.0, 1.0, -1.0], [0.0, 1.0, 0.0, 0.0]])
    shares, arguments = (REACTOR_DISTURBANCE, REACTOR_SENSOR), {"error_gain": REACTOR_GAIN} | bounds
    return _sampled(A, B, H, np.ones(4), 2.0, dt, shares, arguments)


def _sampled(
    A: np.ndarray,
    B: np.ndarray,
    H: np.ndarray,
    half_widths: np.ndarray,
    u_max: float,
    dt: float,
    shares: tuple[float, float],
    arguments: dict[str, Any],
) -> LinearPlant:
    """Returns a plant held constant over each step, with noise bounded by shares of the box's half-widths."""
    n, m = B.shape
    joint = np.zeros((n + m, n + m))
    joint[:n, :n], joint[:n, n:] = A, B
    moved = expm(joint * dt)[:n]
    disturbance, sensor = shares
    delta = arguments.get("delta", 0.05)
    outputs = np.abs(H) @ half_widths
    defaults = {
        "gamma": 0.0,
        "process_noise_cov": np.diag((disturbance * half_widths) ** 2) / chi2_quantile(1.0 - delta, n),
        "measurement_noise_cov": np.diag((sensor * outputs) ** 2) / chi2_quantile(1.0 - delta, len(H)),
        "initial_cov": (sensor * half_widths.min()) ** 2 / chi2_quantile(1.0 - delta, n) * np.eye(n),
    }
    common = {"A": moved[:, :n], "B": moved[:, n:], "C": np.diag(1.0 / half_widths), "H": H, "u_max": u_max, "dt": dt}
    return LinearPlant(**(common | defaults | arguments))
