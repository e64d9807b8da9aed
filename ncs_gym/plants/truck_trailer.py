"""The plant of the case study: a truck that pulls a trailer on a spring-damper coupling."""

from __future__ import annotations

import numpy as np

from ncs_gym.bounds import Ball, Bounds, Gaussian
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import as_number


def truck_trailer(
    mass: float = 1000.0, stiffness: float = 4500.0, damping: float = 4600.0, dt: float = 0.5
) -> LinearPlant:
    """Returns the truck with a spring-damper-coupled trailer of Liu et al. Section 5.

    The exact zero-order hold of x1' = x2, x2' = -(stiffness/mass) x1 - (damping/mass) x2 + u, with x1
    the stretch of the coupling [m], x2 its rate [m/s] and u the truck's acceleration [m/s^2].
    Safe box |x1| <= 2 m, |x2| <= 2 m/s, |u| <= 4 m/s^2; gamma = 5e-4 and Q = P0 = 1e-4 I as in the paper, R = 1e-4 I
    (the paper prints none).

    Args:
        mass: Of the trailer [kg].
        stiffness: Of the coupling [N/m].
        damping: Of the coupling [N s/m].
        dt: Duration of a step [s].

    Raises:
        ValueError: If mass, stiffness or dt is not positive, or damping is negative.
    """
    mass = as_number(mass, "mass", low=0.0, low_open=True)
    stiffness = as_number(stiffness, "stiffness", low=0.0, low_open=True)
    damping = as_number(damping, "damping", low=0.0)
    coupling, push = np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]]), np.array([[0.0], [1.0]])
    noise = Gaussian(1e-4 * np.eye(2), 0.05)
    return LinearPlant(
        Model.sampled(coupling, push, None, dt),
        Limits(state=[2.0, 2.0], input=4.0),
        Bounds(disturbance=Ball(np.sqrt(5e-4)) + noise, sensor=noise, first_error=noise),
        {"states": {"coupling stretch": "m", "stretch rate": "m/s"}, "inputs": {"truck acceleration": "m/s^2"}},
    )
