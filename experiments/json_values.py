"""Values of declared types from JSON: of a settings file, and of stored results, whoever wrote them."""

from __future__ import annotations

import json
import sys
import types
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from ncs_gym.validation import as_numbers


def to_json(value: Any) -> Any:
    """Returns a value as JSON values: a dataclass as the object of its fields, an array as lists, NaN as null."""
    if is_dataclass(value):
        return {each.name: to_json(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, dict):
        return {name: to_json(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(each) for each in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return None if value != value else value


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns JSON values by their dotted names, without the objects that hold others."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found


def from_json(value: Any, kind: Any, name: str = "", *, null: float | None = None) -> Any:
    """Returns a JSON value as a value of a type.

    Args:
        value: The JSON value.
        kind: Type that it has to have: a dataclass, or the type of one of its fields.
        name: Dotted name of the field.
        null: What null stands for where a float is expected; None if it stands for none.

    Raises:
        TypeError: If the value is none of the type; the message names the field.
        ValueError: If a dataclass refuses its fields.
    """
    prefix = f"{name}." if name else ""
    if is_dataclass(kind) and isinstance(value, dict):
        hints, known = get_type_hints(kind), {each.name: each for each in fields(kind)}
        for each in known.values():
            if each.default is MISSING and each.default_factory is MISSING and each.name not in value:
                raise TypeError(f"entries of {name or 'it'} without {each.name}")
        read = {
            key: from_json(each, key in known and hints[key], prefix + key, null=null) for key, each in value.items()
        }
        return kind(**read)  # type: ignore[operator]
    origin, parameters = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        chosen = types.NoneType if value is None else next(each for each in parameters if each is not types.NoneType)
        return from_json(value, chosen, name, null=null)
    if origin is dict and isinstance(value, dict):
        return {key: from_json(each, parameters[1], prefix + key, null=null) for key, each in value.items()}
    if origin in (list, tuple) and isinstance(value, list):
        return origin(from_json(each, parameters[0], f"{prefix}{i}", null=null) for i, each in enumerate(value))
    if kind is np.ndarray:
        numbers = as_numbers(value)
        if numbers is not None and np.isfinite(numbers).all():
            return np.array(value, np.bool_ if np.asarray(value).dtype == np.bool_ else np.float64)
    if kind is Any and _is_strict(value):
        return value
    if kind is Path and isinstance(value, str):
        return Path(value)
    if (origin is Literal and value in parameters) or (
        kind in (bool, int, str, types.NoneType) and type(value) is kind
    ):
        return value
    if kind is float and value is None and null is not None:
        return null
    number: Any = value
    if kind is float and type(number) in (int, float) and abs(number) <= sys.float_info.max and float(number) == number:
        return float(number)  # finite, no NaN and not rounded
    raise TypeError(f"{name} = {json.dumps(value)}")


def _is_strict(value: Any) -> bool:
    """Returns whether a JSON value has neither NaN nor infinity in it."""
    try:
        json.dumps(value, allow_nan=False)
    except ValueError:
        return False
    return True
