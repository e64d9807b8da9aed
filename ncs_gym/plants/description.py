"""A plant as text: sentences for people, what it assumes, and a JSON file in which every number is exact."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import warnings
from dataclasses import MISSING, fields
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.remainder import Remainder
from ncs_gym.validation import as_setting, shown

if TYPE_CHECKING:
    from ncs_gym.plants.linear_plant import LinearPlant

_FORMAT = "ncs-gym plant 1"
# The kinds of uncertainty: what a plant without it assumes, and the arguments that declare it.
_KINDS = {
    "disturbances": ("no disturbance acts on the plant", "disturbance_bound, gamma or process_noise_cov"),
    "sensor noise": ("the sensors measure without noise", "sensor_bound or measurement_noise_cov"),
    "the first estimate": ("the first estimate is exact", "initial_bound or initial_cov"),
}
# Columns of the description: where its texts begin, and where they end.
_INDENT, _WIDTH = 16, 110
# Fingerprints that registered plants had on various processors (x86) before the last digits of their A and B were the
# same on all. A certificate or an agent with one of them belongs to the plant of today: what a certificate claims is
# verified for the numbers of today anyway.
FORMER_FINGERPRINTS = {
    "177ea6db2c10f489ba3cd8ac4f550bcba49144e95e7f714551d3193871f948aa": (
        "29a79af5f1181432d4aca2f00608251d0cfb5c931d2b1a52891c5b2d9711428f",
        "0801c535bdcaf0781d2a22bc8a29c98232f10983aa974ee6bac5e9f24a90641a",
    ),
    "498d4365ce1b7c82e8f7f72490b2a6c638d5352be9511f604179d9a100d7ef23": (
        "8cda9ead9750b9177572854dc51856bf866c023a0b01c027ee5eb2f738d8e58e",
    ),
    "415231d06116184e751fb423e7ade624ca1ad7836c81f9771432b20dd787acc9": (
        "f2b8bd930f5e99a5a9d28b4772529b90353f9aa7f25ff42faccba8ea4d57c035",
        "86b5c2b604b005e58a232ddc738542f67b4c446fbe09604c0cf962bc97d98a27",
        "8459ffddb8aaa5f05a0e5ba4b8616159be91f91f7e2cb2ffc8c8046995f84857",
        "c974ed748068a35ed2252e443207b1358d503b36034e0aef9b5e7a97595d133f",
    ),
    "11e922056fbb24d3d032ed327673ae50290bf75cf5c5fc440c8722b0392ba0d2": (
        "5018bfaf7f890619cef0f066443a308c7c06b6a919636a9eb9683fac9ddb82b8",
        "a6809c736123d225310210aa0dd031fa7fab9c41717255e634cd8747afb62b61",
        "bd2535e8ea23d725f6ec2c7cb813bf3fad707b51fa0ebeb590185825c9c26c7a",
        "621a5733e36d75366467c7f7cbb6cd4e379fde42b93b98eb8adf8052934d0a6a",
    ),
}
# Stands for a space at which no line ends.
_UNBROKEN = "\N{NO-BREAK SPACE}"


class NoNoiseWarning(UserWarning):
    """Nothing is given for an uncertainty, so that the plant assumes there is none; a bound of 0 says so on purpose."""


def warn_of_no_noise(is_given: tuple[bool, bool, bool]) -> None:
    """Warns in one sentence of kinds of uncertainty for which nothing is given.

    Args:
        is_given: Whether anything is given, even zero, for disturbances, sensor noise and the first estimate.
    """
    missing = {kind: text for (kind, text), given in zip(_KINDS.items(), is_given, strict=True) if not given}
    if missing:
        assumed = ", and ".join(f"that {sentence} (give {names})" for sentence, names in missing.values())
        message = f"nothing is given for {' and '.join(missing)}: every certificate will assume {assumed}"
        warnings.warn(f"{message}; a bound of 0 says so on purpose", NoNoiseWarning, stacklevel=_frames_inside())


def assumptions_of(plant: LinearPlant) -> tuple[str, ...]:
    """Returns, in sentences, what a certificate for a plant takes for granted beyond the numbers of its bounds."""
    first = [plant.initial_cov, *([] if plant.initial_bound is None else [plant.initial_bound.shape])]
    zero = (
        not np.any(plant.nominal_disturbance.shape),
        not np.any(plant.nominal_sensor_error.shape),
        not any(np.any(part) for part in first),
    )
    assumed = [
        f"It is assumed that {text}." for (text, _), is_zero in zip(_KINDS.values(), zero, strict=True) if is_zero
    ]
    covariances = ("process_noise_cov", "measurement_noise_cov", "initial_cov")
    truncated = [name for name in covariances if np.any(getattr(plant, name))]
    if truncated:
        kept = f"{100.0 * (1.0 - plant.delta):.6g} % (delta = {plant.delta:g})"
        assumed.append(f"Gaussian noise is truncated: the bounds hold {kept} of {', '.join(truncated)}, not the rest.")
    if plant.remainder is not None:
        assumed.append(plant.remainder.sentence)
    return tuple(assumed)


def describe(plant: LinearPlant) -> str:
    """Returns the limits, the bounds and the assumptions of a plant for people, with units."""
    counts = ((plant.n, "state"), (plant.m, "input"), (plant.p, "output"))
    sizes = ", ".join(f"{count} {name}{'s' * (count != 1)}" for count, name in counts)
    radius = f"spectral radius {plant.spectral_radius:.6g}"
    stable = f"stable ({radius})"
    unstable = f"not stable ({radius}): a certificate needs a contract of the channel"
    extents = {
        "disturbance": (np.sqrt(np.diag(plant.disturbance.shape)), plant.state_names, plant.state_units),
        "sensor noise": (np.sqrt(np.diag(plant.sensor_error.shape)), *_outputs(plant)),
        "first error": (np.sqrt(np.diag(plant.initial_error.shape)), plant.state_names, plant.state_units),
    }
    lines = {
        "linear plant": [f"{sizes}, a step every {plant.dt:g} s"],
        "dynamics": [stable if plant.spectral_radius < 1.0 else unstable],
        "safe box": [row_limit(plant, row) for row in plant.C],
        "input limits": [
            _between(name, limit, center, unit)
            for name, limit, center, unit in zip(
                plant.input_names, plant.u_max, plant.operating_input, plant.input_units, strict=True
            )
        ],
    }
    for title, (sizes_of, names, units) in extents.items():
        parts = [f"{name} up to {_sized(*each)}" for name, *each in zip(names, sizes_of, units, strict=True)]
        lines[title] = [", ".join(part.replace(" ", _UNBROKEN) for part in parts)]
    lines["assumptions"] = list(plant.assumptions)
    shown_lines = (
        fill(text, _WIDTH, initial_indent=f"{title if number == 0 else '':<{_INDENT}}", subsequent_indent=" " * _INDENT)
        for title, texts in lines.items()
        for number, text in enumerate(texts)
    )
    return "\n".join(shown_lines).replace(_UNBROKEN, " ")


def fingerprint_of(plant: LinearPlant) -> str:
    """Returns the SHA-256 over every number of a plant."""
    digest = hashlib.sha256()
    for name in ("A", "B", "C", "H", "u_max", "process_noise_cov", "measurement_noise_cov", "initial_cov"):
        array = getattr(plant, name)
        digest.update(f"{name}{array.shape}".encode() + array.astype("<f8").tobytes())
    digest.update(np.array([plant.dt, plant.gamma, plant.delta], dtype="<f8").tobytes())
    if plant.error_gain is not None:
        digest.update(plant.error_gain.astype("<f8").tobytes())
    for name in ("disturbance_bound", "sensor_bound", "initial_bound", "operating_state", "operating_input"):
        value = getattr(plant, name)
        array = value.shape if isinstance(value, Ellipsoid) else value
        if array is not None and np.any(array):  # a plant without them keeps the fingerprint it always had
            digest.update(name.encode() + array.astype("<f8").tobytes())
    if plant.remainder is not None:
        digest.update(
            f"remainder{plant.remainder.proved}".encode() + plant.remainder.bound.shape.astype("<f8").tobytes()
        )
    return digest.hexdigest()


def has_fingerprint(plant: LinearPlant, fingerprint: str) -> bool:
    """Returns whether a fingerprint is that of a plant, or one that the plant had before: see `FORMER_FINGERPRINTS`."""
    return fingerprint == plant.fingerprint or fingerprint in FORMER_FINGERPRINTS.get(plant.fingerprint, ())


def write_plant(plant: LinearPlant, path: str | os.PathLike[str]) -> None:
    """Writes the JSON file of a plant, in which every number is exact.

    Raises:
        OSError: If the file cannot be written.
    """
    content = {entry.name: _as_json(getattr(plant, entry.name)) for entry in fields(plant)}
    document = {"format": _FORMAT, "plant": content}
    Path(path).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_plant(path: str | os.PathLike[str], kind: type[LinearPlant]) -> dict[str, Any]:
    """Returns the arguments of `LinearPlant` in a JSON file.

    Args:
        path: Of the file.
        kind: The class whose arguments they are.

    Raises:
        ValueError: If the file is missing, no plant's, or its entries are not those of one.
    """
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, TypeError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or "it is not valid JSON"
        raise ValueError(f"cannot read the plant in {shown(path)}: {reason}") from error
    content = document.get("plant") if isinstance(document, dict) and document.get("format") == _FORMAT else None
    if not isinstance(content, dict):
        raise ValueError(f"{shown(path)} is not a plant of format {_FORMAT!r}")
    names = {entry.name: entry.default is MISSING for entry in fields(kind)}
    missing = [name for name, is_needed in names.items() if is_needed and name not in content]
    unknown = [name for name in content if name not in names and name != "C"]
    if (missing and "C" not in content) or unknown:
        wrong = f"it lacks {', '.join(missing)}" if missing else f"{shown(unknown)} are no arguments of LinearPlant"
        raise ValueError(f"{shown(path)} is not the file of a plant: {wrong}")
    arguments = {name: _from_json(value) for name, value in content.items()}
    box = as_setting(arguments.get("box"))
    return arguments if box is None else arguments | {"box": box}  # an array: `save` wrote computed rows


def _as_json(value: Any) -> Any:
    """Returns a field of a plant as a JSON value."""
    if isinstance(value, Ellipsoid):
        return {"shape": value.shape.tolist()}
    if isinstance(value, Remainder):
        return {entry.name: _as_json(getattr(value, entry.name)) for entry in fields(value)}
    return value.tolist() if isinstance(value, np.ndarray) else value


def _from_json(value: Any) -> Any:
    """Returns an argument of `LinearPlant` given as a JSON value; an object is an ellipsoid's shape."""
    if not isinstance(value, dict) or "proved" in value:  # a remainder's
        return value
    if set(value) != {"shape"}:
        raise ValueError(
            f'a bound in the file of a plant must be a number, a list or {{"shape": ...}}, got {shown(value)}'
        )
    return Ellipsoid(value["shape"])


def _frames_inside() -> int:
    """Returns the stack level, seen from `warn_of_no_noise`, of the code outside this package that made the plant."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(
        ("ncs_gym.plants.", "dataclasses")
    ):
        frame, level = frame.f_back, level + 1
    return level


def _sized(size: float, unit: str) -> str:
    """Returns a size with its unit."""
    return f"{size:.4g} {unit}".rstrip()


def _between(name: str, limit: float, center: float, unit: str) -> str:
    """Returns the limits of a quantity around its operating point."""
    if center == 0.0:
        return f"|{name}| <= {_sized(limit, unit)}"
    return f"{center - limit:.6g} <= {name} <= {_sized(center + limit, unit)} (operating point {center:.6g})"


def row_limit(plant: LinearPlant, row: np.ndarray) -> str:
    """Returns what a row of the safe box limits."""
    limited = np.flatnonzero(row).tolist()
    if len(limited) == 1:
        i = limited[0]
        size = 1.0 / abs(row[i])
        return _between(plant.state_names[i], size, plant.operating_state[i], plant.state_units[i])
    terms = " ".join(f"{row[i]:+.4g} {_deviation(plant, i)}" for i in limited)
    return f"|{terms.removeprefix('+')}| <= 1"


def _deviation(plant: LinearPlant, i: int) -> str:
    """Returns the name of a state's deviation from the operating point."""
    center = plant.operating_state[i]
    return f"({plant.state_names[i]} {-center:+.6g})" if center else plant.state_names[i]


def _outputs(plant: LinearPlant) -> tuple[list[str], list[str]]:
    """Returns the names and units of the outputs: those of the states that are measured alone, else y1, y2."""
    names, units = [], []
    for j, row in enumerate(plant.H):
        measured = np.flatnonzero(row)
        alone = len(measured) == 1 and row[measured[0]] == 1.0
        names.append(plant.state_names[measured[0]] if alone else f"y{j + 1}")
        units.append(plant.state_units[measured[0]] if alone else "")
    return names, units
