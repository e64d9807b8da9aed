"""The linear plant: a model, its limits, what bounds its uncertainties, and what follows from these."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import DELTA, Bounds, Gaussian, Sum, Through
from ncs_gym.limits import Limits, as_points
from ncs_gym.model import Model
from ncs_gym.plants import between_samples, plant_file, statespace
from ncs_gym.plants.description import assumptions_of, described
from ncs_gym.plants.hard_bounds import HardBounds, Source, source_of, weight_of
from ncs_gym.plants.limit_values import LimitValues
from ncs_gym.plants.past_inputs import with_past_inputs
from ncs_gym.plants.resting_point import Rest, at_rest, with_residual
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import as_names, as_number, as_units, counted, read_only, shown

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# An unstable plant that nobody holds runs away no further than this many half-widths: what lies beyond ends in NaN.
FARTHEST = 1e30
# Disturbances of a step of a model whose response to a constant is worse conditioned are not traced back to its cause.
LARGEST_CONDITION = 1e9
# What identifies a plant, beside its sets.
_NUMBERS = (
    *("A", "B", "H", "dt", "box", "box_ends", "input_ends", "mixed_rows", "mixed_ends"),
    *("operating_state", "operating_input", "step_offset"),
)


@dataclass(frozen=True, eq=False)
class LinearPlant(LimitValues, HardBounds):
    """x+ = A x + B u + d, y = H x + v, with limits and bounds (docs/shield_proof.md).

    States and inputs are deviations from an operating point: that of the model, which the middle of a disturbance with
    two different ends moves to where it rests. Where inputs take effect late, or the change of inputs is limited, past
    inputs are the last states. Nothing is changed: `dataclasses.replace` makes another plant, checked anew.

    Attributes:
        model: The equations.
        limits: Of states and inputs, in the model's units.
        bounds: Of disturbances, sensor noise and the error of the first estimate, each a sum of sets.
        labels: Names of states and inputs with their units, {"states": {"angle": "rad"}, "inputs": {"voltage": "V"}}.
        A: State matrix, shape (n, n), past inputs included.
        B: Input matrix, shape (n, m).
        H: Output matrix, shape (p, n).
        dt: Duration of a step [s].
        box: Rows c_j of the safe box, shape (k, n), in units of half the range that is allowed; where one end is open,
            the other one is 1 unit away.
        box_ends: The low and the high ends of c_j x, shape (2, k); -1 and 1 where limits are symmetric, infinite where
            there is none.
        is_past_row: Which rows limit past inputs, which nothing ever takes there, shape (k,).
        input_ends: The low and the high ends of the inputs, shape (2, m).
        mixed_rows: Rows of limits on (x, u) at the beginning of a step, shape (q, n + m), in units as those of `box`.
        mixed_ends: Their low and high ends, shape (2, q).
        past: How many of the last states are past inputs, the newest ones last.
        continuous_model: [Ac, Bc] that A and B were sampled from, shape (n, n + m); None if unknown.
        between_samples: Number of times per step at which the box counts; None for the sampling instants alone.
        operating_state: State that deviations are counted from, shape (n,); for conversion and text.
        operating_input: Input that deviations are counted from, shape (m,).
        step_offset: Sizes of what the operating point rests under in every step beside A and B, shape (n,), which do
            not cancel: |offset|, and |E| |middle| of a disturbance with two ends.
        remainder: What the model leaves out of the process that really moves; None if nothing.
        region: Digest of the model and the limits, which a remainder belongs to.
        delta: Probability that Gaussian noise is truncated at.
        of_disturbance, of_sensor, of_first_error: What is declared of each.
        state_names, state_units, input_names, input_units: The labels, with defaults.

    Raises:
        ValueError: If the values do not fit each other.
    """

    model: Model
    limits: Limits
    bounds: Bounds
    labels: Mapping[str, Any] | None = None
    A: np.ndarray = field(init=False)
    B: np.ndarray = field(init=False)
    H: np.ndarray = field(init=False)
    box: np.ndarray = field(init=False)
    box_ends: np.ndarray = field(init=False)
    is_past_row: np.ndarray = field(init=False)
    input_ends: np.ndarray = field(init=False)
    mixed_rows: np.ndarray = field(init=False)
    mixed_ends: np.ndarray = field(init=False)
    operating_state: np.ndarray = field(init=False)
    operating_input: np.ndarray = field(init=False)
    step_offset: np.ndarray = field(init=False)
    dt: float = field(init=False)
    delta: float = field(init=False)
    past: int = field(init=False)
    continuous_model: np.ndarray | None = field(init=False)
    between_samples: int | None = field(init=False)
    remainder: Any = field(init=False)
    region: str = field(init=False)
    of_disturbance: Source = field(init=False)
    of_sensor: Source = field(init=False)
    of_first_error: Source = field(init=False)
    state_names: tuple[str, ...] = field(init=False)
    state_units: tuple[str, ...] = field(init=False)
    input_names: tuple[str, ...] = field(init=False)
    input_units: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        for name, kind in (("model", Model), ("limits", Limits), ("bounds", Bounds)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} must be a {kind.__name__}, got {shown(getattr(self, name))}")
        n, p = len(self.model.A), len(self.model.H)
        sums = [Sum((each,)) for each in (self.bounds.disturbance, self.bounds.sensor, self.bounds.first_error)]
        left_out = [each for each in sums[0].parts if each.is_left_out]
        if len(left_out) > 1 or any(each.is_left_out for other in sums[1:] for each in other.parts):
            raise ValueError("Bounds of disturbances may have one remainder, and others none")
        if len(deltas := {each.gaussian.delta for each in sums if each.gaussian}) > 1:
            raise ValueError(f"all Gaussians of a plant must have the same delta, got {shown(sorted(deltas))}")
        self.bounds.sized(n, p)
        self._set(bounds=Bounds(*sums), delta=min(deltas, default=DELTA))
        declared = sums[0].without(left_out)
        rest = at_rest(self.model, self.limits.within(self.model), declared.sized(n))
        self._derive(rest)
        self._declare([declared, *sums[1:]], rest)
        self._name()
        self._check_between_samples()
        owned = [each.of_plant(self) for each in left_out]
        if owned:
            disturbance = Sum((*declared.parts, *owned))
            self._set(remainder=owned[0], bounds=replace(self.bounds, disturbance=disturbance))
        self._make_arrays_read_only()

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _derive(self, rest: Rest) -> None:
        """Keeps the matrices, the rows and the point."""
        model, (box, inputs, mixed) = self.model, rest.within
        self._set(input_ends=inputs, dt=model.dt, continuous_model=model.continuous)
        change = self.limits.change_within(self.input_half)
        larger = with_past_inputs(model, box, mixed, (inputs, self.input_half), change)
        past, own = larger.past, len(box.rows)
        numbers = np.arange(len(larger.box.rows))
        region = (model.A, model.B, model.dt, *box, inputs, *mixed)
        self._set(
            A=larger.A,
            B=larger.B,
            H=larger.H,
            past=past,
            box=larger.box.rows,
            box_ends=np.stack(larger.box[1:]),
            is_past_row=(own <= numbers) & (numbers < own + past),
            mixed_rows=larger.mixed.rows,
            mixed_ends=np.stack(larger.mixed[1:]),
            operating_state=np.concatenate([rest.state, np.tile(rest.input, past // self.m)]),
            operating_input=rest.input,
            step_offset=np.pad(rest.step_offset, (0, past)),
            between_samples=self.limits.between_samples,
            remainder=None,
            region=_digest(enumerate(region)),
        )

    def _declare(self, sums: list[Any], rest: Rest) -> None:
        """Keeps what is declared of the three uncertainties."""
        n, rows = len(self.model.A), rest.within.box.rows
        weight, past = weight_of(rows, np.zeros(n)), self.past
        disturbance = source_of(sums[0], weight, past, keeps_ball=True)
        if rest.lacking.any():
            shape = np.zeros((n, n)) if disturbance.bound is None else disturbance.bound.shape_matrix[:n, :n]
            held = with_residual(Ellipsoid(shape), rest.lacking, rows).shape_matrix
            disturbance = disturbance._replace(bound=Ellipsoid(np.pad(held, (0, past))))
        sensor = source_of(sums[1], np.eye(len(self.model.H)))
        self._set(of_disturbance=disturbance, of_sensor=sensor, of_first_error=source_of(sums[2], weight, past))

    def _name(self) -> None:
        """Keeps names and units of states and inputs."""
        labels = {} if self.labels is None else self.labels
        if not isinstance(labels, Mapping) or not {*labels} <= {"states", "inputs"}:
            form = '{"states": {name: unit, ...}, "inputs": {name: unit, ...}}'
            raise ValueError(f"labels must be {form}, either of which may be left out, got {shown(labels)}")
        for name, size, letter in (("state", self.n - self.past, "x"), ("input", self.m, "u")):
            given = labels.get(f"{name}s", {})
            if not isinstance(given, Mapping):
                raise ValueError(f"labels of {name}s must be a dictionary of names with units, got {shown(given)}")
            default = tuple(f"{letter}{i + 1}" for i in range(size))
            names, units = [*given], [*given.values()]
            names = as_names(names, default, f"names of {name}s")
            self._set(**{f"{name}_names": names, f"{name}_units": as_units(units, size, f"units of {name}s")})
        ages = [counted(age, "step") for age in range(self.past // self.m, 0, -1)]
        past = tuple(f"{name} of {age} ago" for age in ages for name in self.input_names)
        self._set(
            labels={name: dict(labels[name]) for name in labels} or None,
            state_names=self.state_names + past,
            state_units=self.state_units + self.input_units * len(ages),
        )

    def _check_between_samples(self) -> None:
        """Raises ValueError unless the model in continuous time is one, and there if times between samples count."""
        model = self.model.continuous
        if model is not None:
            widths = np.concatenate([self.half_widths[: len(model)], self.input_half])
            between_samples.require_model_of(model, self.model.A, self.model.B, self.dt, widths)
        if self.between_samples is None:
            return
        if model is None:
            raise ValueError(
                "between_samples needs a model that was sampled from one in continuous time (Model.sampled); plants "
                "that model another process have none"
            )
        if self.past:
            raise ValueError("between_samples is for plants without delays and without limits of rates")
        if any(each.is_left_out for each in self.bounds.disturbance.parts):
            raise ValueError(
                "between_samples is for a plant without a remainder, which says nothing of the times between samples"
            )
        if self.step_offset.any():
            raise ValueError(
                "between_samples is for an operating point that rests without a constant disturbance: how much of "
                f"{shown(self.step_offset.tolist())} per step has come by a time within a step is not known"
            )
        if exact.rank(self.box[np.isfinite(self.box_ends).all(axis=0)]) < self.n:
            raise ValueError("between_samples needs Limits with two ends that bound every state: give generous ones")

    def resampled(self, dt: float) -> LinearPlant:
        """Returns the plant with another duration of a step, which its continuous model knows; itself for the same one.

        Whatever disturbs it is taken to act in continuous time and to be constant during a step: with
        G(dt) = int_0^dt exp(Ac s) ds, the disturbances of a step become G(dt') G(dt)^-1 d. What is declared of sensors
        and of the first estimate stays as it is, and so does `between_samples`: a longer step may need more times.
        Where that is not what disturbs your plant, make the plant anew.

        Raises:
            ValueError: If dt is out of range, the plant has no continuous model, or a remainder or past inputs, which
                belong to its step.
        """
        dt = as_number(dt, "dt", low=0.0, low_open=True)
        if abs(dt - self.dt) <= statespace.SAME_STEP * self.dt:
            return self
        if self.past:
            raise ValueError(f"delays and limits of rates belong to their step: make the plant anew with dt={dt:g}")
        if self.continuous_model is None or self.remainder is not None:
            raise ValueError(
                f"only a plant that was sampled from a model in continuous time, without a remainder, can be sampled "
                f"every {dt:g} s: make it by Model.sampled"
            )
        n, model = self.n, self.model
        Ac, Bc = self.continuous_model[:, :n], self.continuous_model[:, n:]
        of_constant = [statespace.zero_order_hold(Ac, np.eye(n), step)[1] for step in (dt, self.dt)]
        if np.linalg.cond(of_constant[1] * self.half_widths / self.half_widths[:, None]) > LARGEST_CONDITION:
            raise ValueError(f"a step of {self.dt:g} s hides how disturbances act in continuous time: shorten dt")
        G = exact.product(of_constant[0], exact.inverse(of_constant[1]))
        sampled = Model.sampled(Ac, Bc, model.H, dt, model.at)
        if model.offset is not None:
            sampled = replace(sampled, offset=exact.product(G, model.offset))
        disturbance = Sum(tuple(_through(G, each) for each in self.bounds.disturbance.parts))
        return replace(self, model=sampled, bounds=replace(self.bounds, disturbance=disturbance))

    @property
    def document(self) -> dict[str, Any]:
        """What a file of the plant holds, as JSON values: all that it was made with, every number exact."""
        return plant_file.document_of(self)

    @classmethod
    def read(cls, given: Mapping[str, Any] | str | os.PathLike[str]) -> Self:
        """Returns the plant of a `document`, or of the file at a path, checked like any other.

        Raises:
            ValueError: If the file is missing or not that of a plant, or a value is wrong.
        """
        return cls(*plant_file.values_in(given))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Returns the plant in a file of `save`; see `read`."""
        return cls.read(path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a JSON file in which every number is exact.

        Raises:
            OSError: If the file cannot be written.
        """
        Path(path).write_text(json.dumps(self.document, indent=1) + "\n", encoding="utf-8")

    def __str__(self) -> str:
        return described(self)

    def __repr__(self) -> str:
        """Short, in place of all numbers: it is a part of the messages and settings of others."""
        counts = ((self.n, "state"), (self.m, "input"), (self.p, "output"))
        return f"<LinearPlant: {', '.join(counted(*each) for each in counts)}, fingerprint {self.fingerprint[:16]}>"

    @property
    def assumptions(self) -> tuple[str, ...]:
        """What a certificate takes for granted beyond the numbers of the bounds, in sentences."""
        return assumptions_of(self)

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def m(self) -> int:
        """Number of inputs."""
        return self.model.B.shape[1]

    @property
    def p(self) -> int:
        """Number of outputs."""
        return self.model.H.shape[0]

    @cached_property
    def without_remainder(self) -> LinearPlant:
        """The same plant without its remainder: what is declared beside it."""
        if self.remainder is None:
            return self
        declared = self.bounds.disturbance.without([self.remainder])
        return replace(self, bounds=replace(self.bounds, disturbance=declared))

    @cached_property
    def is_symmetric(self) -> bool:
        """Whether the limits are |c_j x| <= 1 and |u_i| <= u_max_i, and no others."""
        low, high = self.input_ends
        symmetric = bool((np.abs(self.box_ends) == 1.0).all() and np.array_equal(-low, high))
        return symmetric and not len(self.mixed_rows)

    @property
    def box_rows(self) -> np.ndarray:
        """Rows c_j of a symmetric safe box |c_j x| <= 1, shape (k, n).

        Raises:
            ValueError: If limits are not symmetric.
        """
        self._require_symmetric("box, box_low and box_high")
        return self.box

    @property
    def u_max(self) -> np.ndarray:
        """Symmetric limits |u_i| <= u_max_i of the inputs, shape (m,).

        Raises:
            ValueError: If limits are not symmetric.
        """
        self._require_symmetric("input_low and input_high")
        return self.input_high

    def _require_symmetric(self, instead: str) -> None:
        if not self.is_symmetric:
            raise ValueError(
                "the limits of this plant are not |c_j x| <= 1 and |u_i| <= u_max_i alone, and only these are taken by "
                f"what was asked for (a plant has {instead}, mixed_rows and mixed_ends)"
            )

    @property
    def members(self) -> Any:
        """The `Family` of which it is the middle; None for a plant that stands for itself."""
        return None if self.remainder is None else self.remainder.family

    @cached_property
    def spectral_radius(self) -> float:
        """Largest absolute eigenvalue of A; below 1 exactly when the plant is Schur stable."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

    @cached_property
    def state_limit(self) -> np.ndarray:
        """Where a simulation stops a state that runs away, shape (n,); infinite for a stable plant."""
        return read_only(FARTHEST * self.half_widths if self.spectral_radius >= 1.0 else np.full(self.n, np.inf))

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over every number that proofs and simulations take of the plant, to bind certificates to it.

        It is the same on every machine: these numbers are given, or rounded once (`ncs_gym.exact`).
        """
        return self.digest()

    def digest(self) -> str:
        """Returns what the fingerprint would be if it were computed now."""
        numbers: list[tuple[Any, Any]] = [(name, getattr(self, name)) for name in _NUMBERS]
        sources: tuple[Source, ...] = (self.of_disturbance, self.of_sensor, self.of_first_error)
        for number, (ball, noise, bound) in enumerate(sources):
            shape = None if bound is None or not bound.shape_matrix.any() else bound.shape_matrix
            energy = noise.energy if noise.covariance.any() else 0.0
            numbers += [(f"set {number}", part) for part in (ball, noise.covariance, energy, shape) if part is not None]
        if self.remainder is not None:
            numbers += self.remainder.numbers
        if self.between_samples is not None:
            numbers += [("between samples", self.between_samples), ("continuous", self.continuous_model)]
        return _digest(numbers)

    def to_deviation(self, value: ArrayLike, of: str = "state") -> np.ndarray:
        """Returns a physical state, input or output as its deviation from the operating point.

        Args:
            value: Shape (n,), (m,) or (p,), or of many environments (N, n), (N, m) or (N, p).
            of: "state", "input" or "output"; the output at the operating point is H x0.

        Raises:
            ValueError: If `of` is none of these, or the values are no finite vectors of its size.
        """
        center = self._operating_value(of)
        return as_points(value, len(center), f"the {of}") - center

    def from_deviation(self, value: ArrayLike, of: str = "state") -> np.ndarray:
        """Returns the physical state, input or output of a deviation; the inverse of `to_deviation`."""
        center = self._operating_value(of)
        return as_points(value, len(center), f"the {of}") + center

    def _operating_value(self, of: str) -> np.ndarray:
        values = {"state": self.operating_state, "input": self.operating_input, "output": self.H @ self.operating_state}
        if not isinstance(of, str) or of not in values:
            raise ValueError(f"of must be one of {list(values)}, got {shown(of)}")
        return values[of]


def _through(G: np.ndarray, declared: Any) -> Any:
    """Returns the set of all G d, also of Gaussian ones."""
    if not isinstance(declared, Gaussian):
        return Through(G, declared)
    product = exact.product(G, declared.covariance, G.T)
    return Gaussian(0.5 * (product + product.T), declared.delta)


def _digest(numbers: Iterable[tuple[Any, Any]]) -> str:
    """Returns the SHA-256 of arrays with their names, in which 0 and -0 are the same."""
    digest = hashlib.sha256()
    for name, value in numbers:
        array = np.asarray(value, dtype="<f8") + 0.0
        digest.update(f"{name}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()
