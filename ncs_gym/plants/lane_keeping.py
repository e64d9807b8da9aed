"""A car that keeps its lane."""

from __future__ import annotations

import numpy as np

from ncs_gym.bounds import Bounds, Through
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.linear_plant import LinearPlant


def lane_keeping(dt: float = 0.05, speed: float = 20.0) -> LinearPlant:
    """Returns a car that keeps its lane at constant speed, by exact zero-order hold.

    e' = speed psi + w, psi' = u. x = (e [m], psi [rad]): the offset from the middle of the lane and the heading; u is
    the yaw rate, |u| <= 0.4 rad/s. Safe box: 0.5 m and 0.1 rad. Side wind and the slope of the road push the car
    sideways by w, up to 0.4 m/s; offset and heading are measured to within 1 mm and 0.2 mrad.

    Args:
        dt: Step [s].
        speed: Of the car [m/s].
    """
    motion = np.array([[0.0, speed], [0.0, 0.0]])
    turn, push = np.array([[0.0], [1.0]]), np.array([[1.0], [0.0]])
    model = Model.sampled(motion, turn, None, dt)
    return LinearPlant(
        model,
        Limits(state=[0.5, 0.1], input=0.4),
        Bounds(disturbance=Through(model.held(push), 0.4), sensor=[1e-3, 2e-4], first_error=[1e-2, 2e-3]),
        {"states": {"offset": "m", "heading": "rad"}, "inputs": {"yaw rate": "rad/s"}},
    )
