"""A vehicle that follows another one."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.statespace import sampled_model, zero_order_hold


def convoy(dt: float = 0.1, lag: float = 0.3, **bounds: Any) -> LinearPlant:
    """Returns a vehicle that follows another one at a wanted distance, by exact zero-order hold.

    e' = w - v, v' = (u - v)/lag. x = (e [m], v [m/s]): how much farther than wanted the leader is, and the follower's
    speed beyond the convoy's; u is the speed asked of its drive, |u| <= 2 m/s. Safe box: 1 m and 2 m/s. The leader's
    speed w is up to 0.45 m/s from the convoy's, and nobody tells the follower; both states are measured to within 1 mm
    and 1 mm/s.

    Args:
        dt: Step [s].
        lag: Time constant of the drive [s].
        bounds: Other arguments of `LinearPlant`, in the place of these.
    """
    motion = np.array([[0.0, -1.0], [0.0, -1.0 / lag]])
    drive, leader = np.array([[0.0], [1.0 / lag]]), np.array([[1.0], [0.0]])
    defaults = {
        "box": [1.0, 2.0],
        "u_max": 2.0,
        "disturbance_bound": (zero_order_hold(motion, leader, dt)[1], 0.45),
        "sensor_bound": 1e-3,
        "initial_bound": 0.02,
        "state_names": ("distance error", "speed"),
        "state_units": ("m", "m/s"),
        "input_names": ("speed asked for",),
        "input_units": ("m/s",),
    }
    return LinearPlant(**sampled_model(motion, drive, dt) | defaults | bounds)
