"""The linear plant: a model, its limits, what bounds its uncertainties, and what follows from these."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from ncs_gym.bounds import DELTA, Bounds, Sum
from ncs_gym.limits import Limits, LimitValues
from ncs_gym.model import Model
from ncs_gym.plants.between_samples import BetweenSamples
from ncs_gym.plants.description import assumptions_of, described
from ncs_gym.plants.hard_bounds import Source, weight_of
from ncs_gym.plants.past_inputs import with_past_inputs
from ncs_gym.plants.resting_point import at_rest, with_residual
from ncs_gym.reading import json_values, read_text
from ncs_gym.uncertainty.ellipsoid import Ellipsoid, document_of, read_back
from ncs_gym.validation import as_names, counted, read_only, reason_of, shown

# An unstable plant that nobody holds runs away no further than this many half-widths: what lies beyond ends in NaN.
FARTHEST = 1e30
# What identifies a plant, beside its sets.
_NUMBERS = (
    *("A", "B", "H", "dt", "box", "box_ends", "input_ends", "mixed_rows", "mixed_ends"),
    *("operating_state", "operating_input", "step_offset"),
)
_FORMAT = "ncs-gym plant 2"
_VALUES: dict[str, type] = {"model": Model, "limits": Limits, "bounds": Bounds}


@dataclass(frozen=True, eq=False, repr=False)
class LinearPlant(BetweenSamples):
    """x+ = A x + B u + d, y = H x + v, with limits and bounds (docs/shield_proof.md).

    States and inputs are deviations from an operating point: that of the model, which the middle of a disturbance moves
    to where it rests. Past inputs are the last states if inputs take effect late or their change is limited. What
    follows is listed by `LimitValues`, `HardBounds` and `BetweenSamples`. `dataclasses.replace` makes another plant.

    Attributes:
        model: The equations.
        limits: Of states and inputs, in the model's units.
        bounds: Each a sum of sets.
        labels: Names of states and inputs with their units, {"states": {"angle": "rad"}, "inputs": {"voltage": "V"}}.
        region: Digest of the model and the limits, which a remainder belongs to.

    Raises:
        ValueError: If the values do not fit each other.
    """

    model: Model
    limits: Limits
    bounds: Bounds
    labels: Mapping[str, Any] | None = None
    region: str = field(init=False)

    def __post_init__(self) -> None:
        for name, kind in _VALUES.items():
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} must be a {kind.__name__}, got {shown(getattr(self, name))}")
        model, n = self.model, len(self.model.A)
        sums = self.bounds.sums(n, len(model.H))
        declared = sums[0].declared
        rest = at_rest(self.limits.around(model), declared.sized(n))
        region = model.A, model.B, model.dt, rest.box, *rest.box_ends, rest.input_ends
        region += rest.mixed_rows, *rest.mixed_ends
        self._set(bounds=Bounds(*sums), remainder=None, region=_digest(enumerate(region)))
        whole = with_past_inputs(rest, model.delays, self.limits.change_within(rest.input_half))
        self._set(**whole.values, n=len(whole.A), m=whole.B.shape[1], p=len(whole.H))
        self._declare([declared, *sums[1:]], rest)
        self._name()
        self._check_between_samples()
        if owned := [each.of_plant(self) for each in sums[0].parts if each.is_left_out]:
            disturbance = Sum((*declared.parts, *owned))
            self._set(remainder=owned[0], bounds=replace(self.bounds, disturbance=disturbance))

    def _declare(self, sums: list[Sum], rest: LimitValues) -> None:
        n, rows = len(rest.A), rest.box
        weight, past = weight_of(rows, np.zeros(n)), self.past
        disturbance = Source.of(sums[0], weight, past, keeps_ball=True)
        if rest.lacking.any():
            shape = np.zeros((n, n)) if disturbance.bound is None else disturbance.bound.shape_matrix[:n, :n]
            held = with_residual(Ellipsoid(shape), rest.lacking, rows).shape_matrix
            disturbance = disturbance._replace(bound=Ellipsoid(np.pad(held, (0, past))))
        sensor, first = Source.of(sums[1], np.eye(self.p)), Source.of(sums[2], weight, past)
        self._set(of_disturbance=disturbance, of_sensor=sensor, of_first_error=first)
        self._set(delta=next((each.gaussian.delta for each in sums if each.gaussian), DELTA))

    def _name(self) -> None:
        labels = {} if self.labels is None else self.labels
        fits = isinstance(labels, Mapping) and {*labels} <= {"states", "inputs"}
        if not fits or not all(isinstance(each, Mapping) for each in labels.values()):
            form = '{"states": {name: unit, ...}, "inputs": {name: unit, ...}}'
            raise ValueError(f"labels must be {form}, either of which may be left out, got {shown(labels)}")
        for name, size, letter in (("state", self.n - self.past, "x"), ("input", self.m, "u")):
            given = labels.get(f"{name}s", {})
            names = as_names([*given], tuple(f"{letter}{i + 1}" for i in range(size)), f"names of {name}s")
            units = as_names([*given.values()], ("",) * size, f"units of {name}s")
            units = tuple("" if unit == "1" else unit for unit in units)
            self._set(**{f"{name}_names": names, f"{name}_units": units})
        ages = [counted(age, "step") for age in range(self.past // self.m, 0, -1)]
        past = tuple(f"{name} of {age} ago" for age in ages for name in self.input_names)
        self._set(state_names=self.state_names + past, state_units=self.state_units + self.input_units * len(ages))
        self._set(labels={name: dict(labels[name]) for name in labels} or None)

    @property
    def document(self) -> dict[str, Any]:
        """What it was made with, as JSON values, every number exact."""
        document: dict[str, Any] = {"format": _FORMAT}
        for name in _VALUES:
            value = getattr(self, name)
            document[name] = {each.name: document_of(getattr(value, each.name)) for each in fields(value) if each.init}
        return document | {"labels": document_of(self.labels)}

    @classmethod
    def load(cls, given: Mapping[str, Any] | str | os.PathLike[str]) -> Self:
        """Returns the plant in a file of `save`, or of a `document`.

        Raises:
            ValueError: If the file is missing or not that of a plant, or a value is wrong.
        """
        name = "the document" if isinstance(given, Mapping) else shown(given)
        try:
            document = given if isinstance(given, Mapping) else json_values(read_text(given))
        except (OSError, TypeError, ValueError, RecursionError) as error:
            reason = getattr(error, "strerror", None) or "it is not valid JSON"
            raise ValueError(f"cannot read the plant in {name}: {reason}") from error
        if not isinstance(document, Mapping) or document.get("format") != _FORMAT:
            raise ValueError(f"{name} is not a plant of format {_FORMAT!r}")
        try:
            values = {**document, "limits": read_back(document["limits"])}
            return cls(**{key: kind(**values[key]) for key, kind in _VALUES.items()}, labels=values["labels"])
        except (KeyError, TypeError, RecursionError) as error:  # a value is missing, or has other entries
            raise ValueError(f"{name} is not that of a plant: {reason_of(error)}") from error

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a JSON file in which every number is exact."""
        Path(path).write_text(json.dumps(self.document, indent=1) + "\n", encoding="utf-8")

    def __str__(self) -> str:
        return described(self)

    assumptions = property(assumptions_of)

    def __repr__(self) -> str:
        """Short, since messages and settings of others contain it."""
        counts = ((self.n, "state"), (self.m, "input"), (self.p, "output"))
        return f"<LinearPlant: {', '.join(counted(*each) for each in counts)}, fingerprint {self.fingerprint[:16]}>"

    @cached_property
    def without_remainder(self) -> LinearPlant:
        """The same plant without its remainder."""
        if self.remainder is None:
            return self
        return replace(self, bounds=replace(self.bounds, disturbance=self.bounds.disturbance.declared))

    @property
    def members(self) -> Any:
        """The `Family` of which it is the middle; None for a plant that stands for itself."""
        return None if self.remainder is None else self.remainder.family

    @cached_property
    def state_limit(self) -> np.ndarray:
        """Where a simulation stops a state that runs away, shape (n,); infinite for a stable plant."""
        return read_only(FARTHEST * self.half_widths if self.spectral_radius >= 1.0 else np.full(self.n, np.inf))

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over every number that proofs and simulations take of the plant, the same on every machine."""
        return self.digest()

    def digest(self) -> str:
        """Returns what the fingerprint would be if it were computed now."""
        numbers: list[tuple[Any, Any]] = [(name, getattr(self, name)) for name in _NUMBERS]
        for number, (ball, noise, bound) in enumerate((self.of_disturbance, self.of_sensor, self.of_first_error)):
            shape = None if bound is None or not bound.shape_matrix.any() else bound.shape_matrix
            energy = noise.energy if noise.covariance.any() else 0.0
            numbers += [(f"set {number}", part) for part in (ball, noise.covariance, energy, shape) if part is not None]
        if self.remainder is not None:
            numbers += self.remainder.numbers
        if self.between_samples is not None:
            numbers += [("between samples", self.between_samples), ("continuous", self.continuous_model)]
        return _digest(numbers)


def _digest(numbers: Iterable[tuple[Any, Any]]) -> str:
    """Returns the SHA-256 of arrays with their names, in which 0 and -0 are the same."""
    digest = hashlib.sha256()
    for name, value in numbers:
        array = np.asarray(value, dtype="<f8") + 0.0
        digest.update(f"{name}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()
