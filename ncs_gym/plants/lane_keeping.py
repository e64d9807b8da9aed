"""A car that keeps its lane."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.statespace import sampled_model, zero_order_hold


def lane_keeping(dt: float = 0.05, speed: float = 20.0, **bounds: Any) -> LinearPlant:
    """Returns a car that keeps its lane at constant speed, by exact zero-order hold.

    e' = speed psi + w, psi' = u. x = (e [m], psi [rad]): the offset from the middle of the lane and the heading; u is
    the yaw rate, |u| <= 0.4 rad/s. Safe box: 0.5 m and 0.1 rad. Side wind and the slope of the road push the car
    sideways by w, up to 0.4 m/s; offset and heading are measured to within 1 mm and 0.2 mrad.

    Args:
        dt: Step [s].
        speed: Of the car [m/s].
        bounds: Other arguments of `LinearPlant`, in the place of these.
    """
    motion = np.array([[0.0, speed], [0.0, 0.0]])
    turn, push = np.array([[0.0], [1.0]]), np.array([[1.0], [0.0]])
    defaults = {
        "box": [0.5, 0.1],
        "u_max": 0.4,
        "disturbance_bound": (zero_order_hold(motion, push, dt)[1], 0.4),
        "sensor_bound": [1e-3, 2e-4],
        "initial_bound": [1e-2, 2e-3],
        "state_names": ("offset", "heading"),
        "state_units": ("m", "rad"),
        "input_names": ("yaw rate",),
        "input_units": ("rad/s",),
    }
    return LinearPlant(**sampled_model(motion, turn, dt) | defaults | bounds)
