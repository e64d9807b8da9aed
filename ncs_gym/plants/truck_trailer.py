"""The plant of the case study: a truck that pulls a trailer on a spring-damper coupling."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.statespace import sampled_model
from ncs_gym.validation import as_matrix, as_number


def truck_trailer(
    mass: float = 1000.0, stiffness: float = 4500.0, damping: float = 4600.0, dt: float = 0.5, **bounds: Any
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
        bounds: Other arguments of `LinearPlant`, in the place of these.

    Raises:
        ValueError: If mass, stiffness or dt is not positive, damping is negative, or a bound is wrong.
    """
    mass = as_number(mass, "mass", low=0.0, low_open=True)
    stiffness = as_number(stiffness, "stiffness", low=0.0, low_open=True)
    damping = as_number(damping, "damping", low=0.0)
    dt = as_number(dt, "dt", low=0.0, low_open=True)
    coupling, push = np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]]), np.array([[0.0], [1.0]])
    given = {name: value for name, value in bounds.items() if value is not None}
    p = len(as_matrix(given["H"], (None, 2), "H")) if "H" in given else 2
    defaults = {
        "box": [2.0, 2.0],
        "u_max": 4.0,
        "gamma": 5e-4,
        "process_noise_cov": 1e-4 * np.eye(2),
        "measurement_noise_cov": 1e-4 * np.eye(p),
        "initial_cov": 1e-4 * np.eye(2),
        "state_names": ("coupling stretch", "stretch rate"),
        "state_units": ("m", "m/s"),
        "input_names": ("truck acceleration",),
        "input_units": ("m/s^2",),
    }
    return LinearPlant(**sampled_model(coupling, push, dt) | defaults | given)
