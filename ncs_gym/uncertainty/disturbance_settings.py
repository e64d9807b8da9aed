"""What the settings of disturbance and noise stand for."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.bounded_disturbances import BallDisturbance, BoxDisturbance, SinusoidDisturbance
from ncs_gym.uncertainty.disturbance import CallableDisturbance, Disturbance
from ncs_gym.uncertainty.extremal_disturbances import AdversarialDisturbance, SphereDisturbance
from ncs_gym.validation import shown

BY_NAME: dict[str, type[Disturbance]] = {
    "ball": BallDisturbance,
    "box": BoxDisturbance,
    "sinusoid": SinusoidDisturbance,
    "sphere": SphereDisturbance,
    "adversarial": AdversarialDisturbance,
}
# How the noise of a plant may be drawn: inside the bounds that its covariances are truncated at, without a bound, or
# with sensor noise and first errors on their bounds.
NOISES = ("truncated", "gaussian", "extreme")


def stays_inside(source: Disturbance) -> bool:
    """Returns whether a disturbance lies in E(D) by construction: that of this module's own classes does."""
    return type(source) in BY_NAME.values()


def as_disturbance(value: Any, plant: LinearPlant, allow_assumption_violation: bool) -> Disturbance:
    """Returns the settings for a name, a `Disturbance` or a callable (rng, plant, nominal_next) -> d.

    Raises:
        ValueError: If the name is unknown, the value is none of these, or it does not suit the plant.
    """
    if isinstance(value, str) and value in BY_NAME:
        value = BY_NAME[value]()
    elif not isinstance(value, Disturbance | type) and callable(value):
        function: Any = value
        value = CallableDisturbance(function)
    if not isinstance(value, Disturbance):
        raise ValueError(
            f"disturbance must be one of {sorted(BY_NAME)}, a Disturbance or a callable, got {shown(value)}"
        )
    problem = value.check(plant)
    if not problem and not allow_assumption_violation:
        problem = value.excess(plant)
    if problem:
        raise ValueError(f"{type(value).__name__}: {problem}")
    return value


def as_noise(value: Any, plant: LinearPlant) -> str:
    """Returns "truncated", "gaussian" or "extreme", checked.

    "gaussian" draws what a covariance describes, which is process noise, sensor noise and first error, from the
    Gaussian itself. What is bounded by declaration (`gamma`, `disturbance_bound`, `sensor_bound`, `initial_bound`) has
    no distribution beyond its bound and stays inside. "extreme" draws sensor noise and first errors in random
    directions on the boundary of what is assumed of them.

    Raises:
        ValueError: If it is another value, or "gaussian" for a plant without any covariance.
    """
    if not (isinstance(value, str) and value in NOISES):
        raise ValueError(f"noise must be one of {list(NOISES)}, got {shown(value)}")
    covariances = plant.process_noise_cov, plant.measurement_noise_cov, plant.initial_cov
    if value == "gaussian" and not any(np.any(each) for each in covariances):
        raise ValueError(
            'noise="gaussian" needs a covariance of process noise, sensor noise or first error: this plant declares '
            "bounds only, beyond which nothing says how likely anything is"
        )
    return value
