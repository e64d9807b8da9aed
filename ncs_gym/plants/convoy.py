"""A vehicle that follows another one."""

from __future__ import annotations

import numpy as np

from ncs_gym.bounds import Ball, Bounds, Through
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.linear_plant import LinearPlant


def convoy(dt: float = 0.1, lag: float = 0.3) -> LinearPlant:
    """Returns a vehicle that follows another one at a wanted distance, by exact zero-order hold.

    e' = w - v, v' = (u - v)/lag. x = (e [m], v [m/s]): how much farther than wanted the leader is, and the follower's
    speed beyond the convoy's; u is the speed asked of its drive, |u| <= 2 m/s. Safe box: 1 m and 2 m/s. The leader's
    speed w is up to 0.45 m/s from the convoy's, and nobody tells the follower; both states are measured to within 1 mm
    and 1 mm/s.

    Args:
        dt: Step [s].
        lag: Time constant of the drive [s].
    """
    motion = np.array([[0.0, -1.0], [0.0, -1.0 / lag]])
    drive, leader = np.array([[0.0], [1.0 / lag]]), np.array([[1.0], [0.0]])
    model = Model.sampled(motion, drive, None, dt)
    return LinearPlant(
        model,
        Limits(state=[1.0, 2.0], input=2.0),
        Bounds(disturbance=Through(model.held(leader), 0.45), sensor=Ball(1e-3), first_error=Ball(0.02)),
        {"states": {"distance error": "m", "speed": "m/s"}, "inputs": {"speed asked for": "m/s"}},
    )
