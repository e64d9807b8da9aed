"""Settings as JSON values, which is what `EnvSpec.to_json` makes of the objects: dictionaries of their fields."""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from typing import Any

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes import CartPoleProcess, InvertedPendulumProcess, PendulumProcess
from ncs_gym.tasks.regulation import Regulation
from ncs_gym.tasks.setpoint_tracking import SetpointTracking
from ncs_gym.tasks.speed_tracking import SpeedTracking
from ncs_gym.uncertainty.bounded_disturbances import BoxDisturbance, SinusoidDisturbance
from ncs_gym.validation import shown

# What a dictionary can stand for where the class is not known: told apart by the names of their fields.
TASKS: tuple[type, ...] = (Regulation, SpeedTracking, SetpointTracking)
DISTURBANCES: tuple[type, ...] = (BoxDisturbance, SinusoidDisturbance)
PROCESSES: tuple[type, ...] = (CartPoleProcess, PendulumProcess, InvertedPendulumProcess)


def from_json(value: Any, kinds: tuple[type, ...], name: str) -> Any:
    """Returns the object whose fields a dictionary holds; a value that is no dictionary as it is.

    Args:
        value: The value of a setting.
        kinds: Dataclasses that a dictionary may hold the fields of.
        name: Name of the setting.

    Raises:
        ValueError: If the dictionary holds the fields of none of them, or of several, or a wrong value.
    """
    if not isinstance(value, dict):
        return value
    names = {kind: {entry.name for entry in fields(kind)} for kind in kinds}
    fitting = [kind for kind in kinds if set(value) <= names[kind]]
    try:
        if len(fitting) == 1:
            return fitting[0](**value)
    except TypeError:  # a field without a default is missing
        pass
    known = " or ".join(f"a {kind.__name__} ({', '.join(sorted(names[kind]))})" for kind in kinds)
    raise ValueError(f"{name} must be the settings of {known}, got {shown(value)}")


def as_plant(value: Any) -> Any:
    """Returns the plant in a file that `LinearPlant.save` wrote, for its path; any other value as it is.

    Raises:
        ValueError: If the file is missing or holds no plant.
    """
    return LinearPlant.load(Path(value)) if isinstance(value, (str, os.PathLike)) else value
