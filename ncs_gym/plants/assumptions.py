"""What a certificate of a plant takes for granted beyond the numbers of its bounds, in sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

# What a plant without each kind of uncertainty assumes.
_WITHOUT = ("no disturbance acts on the plant", "the sensors measure without noise", "the first estimate is exact")


def assumptions_of(plant: LinearPlant) -> tuple[str, ...]:
    """Returns what is assumed of everything uncertain about a plant."""
    first = [plant.initial_cov, *([] if plant.initial_bound is None else [plant.initial_bound.shape_matrix])]
    zero = (
        not np.any(plant.nominal_disturbance.shape_matrix),
        not np.any(plant.nominal_sensor_error.shape_matrix),
        not any(np.any(part) for part in first),
    )
    assumed = [f"It is assumed that {text}." for text, is_zero in zip(_WITHOUT, zero, strict=True) if is_zero]
    noises = {
        "disturbances": plant.process_noise_cov,
        "sensor noise": plant.measurement_noise_cov,
        "the first error": plant.initial_cov,
    }
    if truncated := [name for name, covariance in noises.items() if np.any(covariance)]:
        kept = f"{100.0 * (1.0 - plant.delta):.6g} % (delta = {plant.delta:g}) of {', '.join(truncated)}"
        assumed.append(f"Gaussian noise is truncated: the bounds hold {kept}, not the rest.")
    if plant.remainder is not None:
        assumed.append(plant.remainder.sentence)
    if plant.between_samples is not None:
        assumed.append("What disturbances have done by any time within a step respects the bound of a whole step.")
    return tuple(assumed)
