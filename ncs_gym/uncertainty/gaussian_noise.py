"""Whether noise is truncated, so that a bound holds, or Gaussian without a bound."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import shown

# How the noise of a plant may be drawn: inside the bounds that its covariances are truncated at, or without a bound.
NOISES = ("truncated", "gaussian")


def as_noise(value: Any, plant: LinearPlant) -> str:
    """Returns "truncated" or "gaussian", checked.

    "gaussian" draws what a covariance describes, which is process noise, sensor noise and first error, from the
    Gaussian itself. What is bounded by declaration (`gamma`, `disturbance_bound`, `sensor_bound`, `initial_bound`) has
    no distribution beyond its bound and stays inside.

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
