"""The file of a plant: JSON in which every number is exact."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from ncs_gym.bounds import Bounds
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.reading import json_values, read_text
from ncs_gym.uncertainty.ellipsoid import document_of as as_json
from ncs_gym.uncertainty.ellipsoid import read_back
from ncs_gym.validation import reason_of, shown

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

_FORMAT = "ncs-gym plant 2"
_KINDS: dict[str, type] = {"model": Model, "limits": Limits, "bounds": Bounds}


def document_of(plant: LinearPlant) -> dict[str, Any]:
    """Returns what a file of the plant holds, as JSON values: all that it was made with."""
    document: dict[str, Any] = {"format": _FORMAT}
    for name in _KINDS:
        value = getattr(plant, name)
        document[name] = {each.name: as_json(getattr(value, each.name)) for each in fields(value) if each.init}
    return document | {"labels": as_json(plant.labels)}


def values_in(given: Mapping[str, Any] | str | os.PathLike[str]) -> tuple[Any, ...]:
    """Returns the values of the plant of a document, or of the file at a path.

    Raises:
        ValueError: If the file is missing or not that of a plant, or a value is wrong.
    """
    document, name = given, "the document"
    if not isinstance(given, Mapping):
        name = shown(given)
        try:
            document = json_values(read_text(given))
        except (OSError, TypeError, ValueError, RecursionError) as error:
            reason = getattr(error, "strerror", None) or "it is not valid JSON"
            raise ValueError(f"cannot read the plant in {name}: {reason}") from error
    if not isinstance(document, Mapping) or document.get("format") != _FORMAT:
        raise ValueError(f"{name} is not a plant of format {_FORMAT!r}")
    try:
        given = {**document, "limits": read_back(document["limits"])}
        return *(kind(**given[key]) for key, kind in _KINDS.items()), given["labels"]
    except (KeyError, TypeError, RecursionError) as error:  # a value is missing, or has other entries
        raise ValueError(f"{name} is not that of a plant: {reason_of(error)}") from error
