"""Settings of environments as JSON values, as an `EnvSpec` holds them, and back again."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from copy import copy
from dataclasses import fields, is_dataclass
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from gymnasium.envs.registration import EnvSpec

from ncs_gym.disturbances import (
    AdversarialDisturbance,
    BallDisturbance,
    BoxDisturbance,
    SinusoidDisturbance,
    SphereDisturbance,
)
from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.network.channel import Channel, ChannelContract, GilbertElliott, TraceChannel
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.cart_pole_process import CartPoleProcess
from ncs_gym.processes.gym_pendulum import PendulumProcess
from ncs_gym.processes.mujoco_pendulum import InvertedPendulumProcess
from ncs_gym.processes.process import FamilyProcess, LinearProcess
from ncs_gym.tasks import TASKS
from ncs_gym.validation import shown

# What a dictionary of fields stands for in these settings; several classes are told apart by the names of their fields.
JSON_SETTINGS: dict[str, tuple[type, ...]] = {
    "channel": (Channel,),
    "task": TASKS,
    "disturbance": (BoxDisturbance, SinusoidDisturbance),
    "initial_set": (Ellipsoid,),
    "contract": (ChannelContract,),
    "process": (CartPoleProcess, PendulumProcess, InvertedPendulumProcess),
    "downlink": (Channel,),
    "downlink_contract": (ChannelContract,),
}
# Classes whose fields do not tell them apart: their dictionaries have the class's name as "type".
_BY_TYPE: dict[str, type] = {
    each.__name__: each
    for each in (
        TraceChannel,
        BallDisturbance,
        SphereDisturbance,
        AdversarialDisturbance,
        LinearProcess,
        FamilyProcess,
    )
}
_BY_FIELDS = {each for kinds in JSON_SETTINGS.values() for each in kinds} | {GilbertElliott}
# Plants by their documents: environments of one plant share what was computed for it.
_plants: WeakValueDictionary[str, LinearPlant] = WeakValueDictionary()


class SpecOfJson:
    """Mixin of environments whose `spec` holds their settings as JSON values, as far as they can be."""

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> Any:
        """What `gym.make` makes the environment of again; None for one that it did not make."""
        return self._spec

    @spec.setter
    def spec(self, made_of: EnvSpec | None) -> None:
        if made_of is not None:
            made_of = copy(made_of)
            made_of.kwargs = to_json(made_of.kwargs)
        self._spec = made_of


def to_json(value: Any) -> Any:
    """Returns the JSON value of a setting, of which `from_json` or `read_plant` makes the same again.

    What is of a class of others, or holds a function, is returned as it is.
    """
    if isinstance(value, LinearPlant):
        if value.members is not None and value.members.function is not None:
            return value
        document = value.document
        _plants[_key(document)] = value
        return document
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, list | tuple):
        return [to_json(each) for each in value]
    if isinstance(value, dict):
        return {name: to_json(each) for name, each in value.items()}
    kind = type(value)
    if not is_dataclass(kind) or (kind not in _BY_FIELDS and _BY_TYPE.get(kind.__name__) is not kind):
        return value
    named = {} if kind in _BY_FIELDS else {"type": kind.__name__}
    return named | {entry.name: to_json(getattr(value, entry.name)) for entry in fields(kind)}


def from_json(value: Any, kinds: tuple[type, ...], name: str) -> Any:
    """Returns the object of one of some dataclasses whose fields a dictionary holds; any other value as it is.

    Raises:
        ValueError: If the dictionary holds the fields of none of them, or of several, or a wrong value.
    """
    if not isinstance(value, dict):
        return value
    if value.get("type") in _BY_TYPE:
        kinds = (_BY_TYPE[value["type"]],)
        value = {key: each for key, each in value.items() if key != "type"}
    names = {kind: {entry.name for entry in fields(kind)} for kind in kinds}
    fitting = [kind for kind in kinds if set(value) <= names[kind]]
    try:
        if len(fitting) == 1:
            return fitting[0](**value)
    except TypeError:  # a field without a default is missing
        pass
    known = " or ".join(f"a {kind.__name__} ({', '.join(sorted(names[kind]))})" for kind in kinds)
    raise ValueError(f"{name} must be the settings of {known}, got {shown(value)}")


def read_plant(given: Any) -> Any:
    """Returns the plant that a document, or the path of a file, stands for; any other value as it is."""
    if not isinstance(given, Mapping):
        return LinearPlant.load(given) if isinstance(given, str | os.PathLike) else given
    try:
        key = _key(given)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"the document of a plant must be JSON values: {error}") from error
    plant = _plants.get(key)
    if plant is None:
        plant = _plants[key] = LinearPlant.load(given)
    return plant


def _key(document: Mapping[str, Any]) -> str:
    return json.dumps(document, sort_keys=True)
