"""An inverted pendulum on a cart, linearized upright."""

from __future__ import annotations

import numpy as np

from ncs_gym.bounds import noise_in_proportion
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.linear_plant import LinearPlant

GRAVITY = 9.81
# Bounds on disturbance and sensor noise as fractions of the half-widths of the box.
DISTURBANCE_FRACTION = 1.2e-3
SENSOR_FRACTION = 1e-4


def cart_pole(
    cart_mass: float = 1.0,
    pole_mass: float = 0.1,
    length: float = 0.5,
    dt: float = 0.02,
    full_state: bool = True,
) -> LinearPlant:
    """Returns an inverted pendulum on a cart, linearized upright, by exact zero-order hold.

    x = (position [m], speed [m/s], angle [rad], angular rate [rad/s]), u the force on the cart [N], |u| <= 10. Safe
    box: 2.4 m, 3 m/s, 0.2 rad, 2 rad/s. The environment simulates the linear equations, which differ from those of a
    pendulum by less than 1 % of gravity's pull at the edge of the box (sin 0.2 = 0.1987).

    Args:
        cart_mass: Of the cart [kg].
        pole_mass: Of a point mass at the end of a light rod [kg].
        length: Of the rod [m].
        dt: Step [s].
        full_state: Measure all states; False measures position and angle.
    """
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1, 2] = -pole_mass * GRAVITY / cart_mass
    A[3, 2] = (cart_mass + pole_mass) * GRAVITY / (cart_mass * length)
    B = np.array([[0.0], [1.0 / cart_mass], [0.0], [-1.0 / (cart_mass * length)]])
    half_widths = np.array([2.4, 3.0, 0.2, 2.0])
    H = np.eye(4) if full_state else np.eye(4)[[0, 2]]
    disturbance = DISTURBANCE_FRACTION if full_state else 0.4 * DISTURBANCE_FRACTION
    return LinearPlant(
        Model.sampled(A, B, H, dt),
        Limits(state=half_widths, input=10.0),
        noise_in_proportion(half_widths, H, disturbance, SENSOR_FRACTION),
        {
            "states": {"position": "m", "speed": "m/s", "angle": "rad", "angular rate": "rad/s"},
            "inputs": {"force": "N"},
        },
    )
