"""What a certificate of a plant takes for granted beyond the numbers of its bounds, in sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ncs_gym.validation import warn_caller

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

# The kinds of uncertainty: what a plant without it assumes, and the arguments that declare it.
_KINDS = {
    "disturbances": ("no disturbance acts on the plant", "disturbance_bound, gamma or process_noise_cov"),
    "sensor noise": ("the sensors measure without noise", "sensor_bound or measurement_noise_cov"),
    "the first estimate": ("the first estimate is exact", "initial_bound or initial_cov"),
}


class NoNoiseWarning(UserWarning):
    """Nothing is given for an uncertainty, so that the plant assumes there is none; a bound of 0 says so on purpose."""


def assumptions_of(plant: LinearPlant) -> tuple[str, ...]:
    """Returns what is assumed of everything uncertain about a plant."""
    first = [plant.initial_cov, *([] if plant.initial_bound is None else [plant.initial_bound.shape_matrix])]
    zero = (
        not np.any(plant.nominal_disturbance.shape_matrix),
        not np.any(plant.nominal_sensor_error.shape_matrix),
        not any(np.any(part) for part in first),
    )
    assumed = [
        f"It is assumed that {text}." for (text, _), is_zero in zip(_KINDS.values(), zero, strict=True) if is_zero
    ]
    covariances = ("process_noise_cov", "measurement_noise_cov", "initial_cov")
    truncated = [name for name in covariances if np.any(getattr(plant, name))]
    if truncated:
        kept = f"{100.0 * (1.0 - plant.delta):.6g} % (delta = {plant.delta:g}) of {', '.join(truncated)}"
        assumed.append(f"Gaussian noise is truncated: the bounds hold {kept}, not the rest.")
    if plant.remainder is not None:
        assumed.append(plant.remainder.sentence)
    if plant.between_samples is not None:
        assumed.append("What disturbances have done by any time within a step respects the bound of a whole step.")
    return tuple(assumed)


def warn_of_no_noise(is_given: tuple[bool, bool, bool]) -> None:
    """Warns in one sentence of kinds of uncertainty for which nothing is given.

    Args:
        is_given: Whether anything is given, even zero, for disturbances, sensor noise and the first estimate.
    """
    missing = {kind: text for (kind, text), given in zip(_KINDS.items(), is_given, strict=True) if not given}
    if missing:
        assumed = ", and ".join(f"that {sentence} (give {names})" for sentence, names in missing.values())
        message = f"nothing is given for {' and '.join(missing)}: every certificate will assume {assumed}"
        warn_caller(f"{message}; a bound of 0 says so on purpose", NoNoiseWarning)
