"""The file of a plant: JSON in which every number is exact."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ncs_gym import limits
from ncs_gym.reading import json_values, read_text
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.family import Family
from ncs_gym.uncertainty.remainder import Remainder
from ncs_gym.validation import as_setting, shown

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

_FORMAT = "ncs-gym plant 1"
# What of a remainder, and of the family that it is about, stands in a file.
_OF_REMAINDER, _OF_FAMILY = ("bound", "proved", "basis"), ("names", "parameters", "members", "interval", "at_rest")


def document_of(plant: LinearPlant) -> dict[str, Any]:
    """Returns what a file of the plant holds, as JSON values: all that it was made with."""
    content = {entry.name: _as_json(getattr(plant, entry.name)) for entry in fields(plant)}
    if not plant.step_offset.any():
        del content["step_offset"]
    if not len(plant.mixed_rows):
        del content["mixed_rows"], content["mixed_ends"]
    else:
        content["mixed_ends"] = limits.listed_ends(plant.mixed_ends)
    if plant.is_symmetric:  # in the short form
        del content["box_ends"], content["input_ends"]
        return {"format": _FORMAT, "plant": content | {"u_max": _as_json(plant.u_max)}}
    return {"format": _FORMAT, "plant": content | {"box_ends": limits.listed_ends(plant.box_ends)}}


def arguments_in(given: Mapping[str, Any] | str | os.PathLike[str]) -> tuple[dict[str, Any], str]:
    """Returns the arguments of the plant of a document, or of the file at a path, and the name of either.

    Raises:
        ValueError: If the file is missing or not that of a plant.
    """
    document, name = given, "the document"
    if not isinstance(given, Mapping):
        name = shown(given)
        try:
            document = json_values(read_text(given))
        except (OSError, TypeError, ValueError, RecursionError) as error:
            reason = getattr(error, "strerror", None) or "it is not valid JSON"
            raise ValueError(f"cannot read the plant in {name}: {reason}") from error
    content = document.get("plant") if isinstance(document, Mapping) and document.get("format") == _FORMAT else None
    if not isinstance(content, Mapping):
        raise ValueError(f"{name} is not a plant of format {_FORMAT!r}")
    arguments = {key: _from_json(value) for key, value in content.items()}
    box = as_setting(arguments.get("box"))
    if box is not None:
        arguments["box"] = box  # an array: `save` wrote computed rows
    return arguments, name


def _as_json(value: Any) -> Any:
    if isinstance(value, Ellipsoid):
        return {"shape": value.shape_matrix.tolist()}
    if isinstance(value, Remainder):
        if value.family is not None:  # the bound follows from it
            return _as_json(value.family)
        return {"bound": _as_json(value.bound), "proved": value.is_proved, "basis": value.basis}
    if isinstance(value, Family):
        return {name: _as_json(getattr(value, name)) for name in _OF_FAMILY}
    if isinstance(value, tuple):
        return list(value)
    return value.tolist() if isinstance(value, np.ndarray) else value


def _from_json(value: Any) -> Any:
    """Returns an argument of `LinearPlant` given as a JSON value; an object is an ellipsoid's shape, or a remainder."""
    if not isinstance(value, dict):
        return value
    if set(value) == {*_OF_FAMILY}:
        return Family(**value)
    if set(value) == {*_OF_REMAINDER}:
        return Remainder(**{name: _from_json(each) for name, each in value.items()})
    if set(value) != {"shape"}:
        raise ValueError(
            f'a bound in the file of a plant must be a number, a list or {{"shape": ...}}, got {shown(value)}'
        )
    return Ellipsoid(value["shape"])
