"""The linear plant: a model, its limits, what bounds its uncertainties, what follows from these, and how it reads.

Hard bounds of what is declared, which proofs take and simulations draw from, are the same numbers on every machine
(`ncs_gym.exact`).
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple, Self

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import DELTA, Ball, Bounds, Sum, pushes_of
from ncs_gym.ellipsoid import (
    INFLATION,
    Ellipsoid,
    TruncatedGaussian,
    document_of,
    ellipsoid_around_sum,
    inflated,
    outer_sum,
    read_back,
    truncation_energy,
)
from ncs_gym.limits import Limits, LimitValues, reach_in_steps, weight_of
from ncs_gym.model import Model
from ncs_gym.plants.between_samples import kept_at_all_times
from ncs_gym.reading import json_values, read_text
from ncs_gym.validation import as_names, counted, read_only, reason_of, setting, shown

# No disturbance set is thinner than this, in squared half-widths of the safe box.
THINNEST = 1e-19
# Simulating a step in float64 rounds; the disturbance bound has room for that up to this many half-widths out.
SIMULATED_REACH = 100.0


class Source(NamedTuple):
    """What is declared of one uncertainty, in the dimension of the plant: the sum of three.

    Attributes:
        ball: Squared radius of a ball.
        noise: Truncated Gaussian noise; without any its covariance is zero.
        bound: An ellipsoid around what else is declared; None if nothing is.
    """

    ball: float
    noise: TruncatedGaussian
    bound: Ellipsoid | None

    @classmethod
    def of(cls, declared: Sum, weight: np.ndarray, past: int = 0, *, keeps_ball: bool = False) -> Source:
        """Returns what a sum of sets declares of the own states of a plant, or of its outputs.

        Args:
            declared: The sum.
            weight: W, by which a sum of several sets becomes one ellipsoid.
            past: How many past inputs, which are known, follow.
            keeps_ball: Whether a `Ball` stands for itself, which it cannot beside past inputs.

        Raises:
            ValueError: If a set with two different ends is added to others than a Gaussian.
        """
        size, gaussian = len(weight), declared.gaussian
        covariance, delta = (gaussian.covariance, gaussian.delta) if gaussian else (np.zeros((size, size)), DELTA)
        noise = TruncatedGaussian(np.pad(covariance, (0, past)), truncation_energy(delta, size), past)
        if len(declared.parts) > (2 if gaussian else 1) and pushes_of(declared.sized(size)):
            raise ValueError("only a Gaussian stands beside a set with two different ends: give one Box around the sum")
        balls = [each for each in declared.parts if isinstance(each, Ball) and keeps_ball and not past]
        others = Sum(tuple(each for each in declared.parts if each is not gaussian and each not in balls)).sized(size)
        shape = others.ellipsoid(weight).shape_matrix if others.parts else None
        bound = None if shape is None else Ellipsoid(np.pad(shape, (0, past)))
        return cls(float(np.square(sum(each.radius for each in balls))), noise, bound)

    def bounded(self) -> list[Ellipsoid]:
        """Returns the bounds of all but the noise."""
        ball = Ellipsoid(self.ball * np.eye(len(self.noise.covariance)))
        return [ball, *([] if self.bound is None else [self.bound])]

    def around(self, weight: np.ndarray, *others: Ellipsoid | None) -> Ellipsoid:
        """Returns an ellipsoid around the sum of all and of others, of the smallest tr(W P)."""
        ball, *rest = self.bounded()
        return ellipsoid_around_sum(weight, ball, self.noise.bound, *rest, *others)

    def covariance(self, divisor: float) -> np.ndarray:
        """Returns the covariance of the noise, plus the shapes of the other bounds over a divisor."""
        return np.sum([self.noise.covariance, *(each.shape_matrix / divisor for each in self.bounded())], axis=0)

    def drawn(self, rng: np.random.Generator, count: int | None = None, *, truncated: bool = True) -> np.ndarray:
        """Returns noise plus a uniform point of the bound unless that is one, shape (n,) or (count, n)."""
        samples = self.noise.sample(rng, count, truncated=truncated)
        if self.bound is None or not self.bound.shape_matrix.any():
            return samples
        return samples + self.bound.sample(rng, count)


# Columns of the description: where its texts begin, and where they end.
_INDENT, _WIDTH = 16, 80
# What an end of a limit and its operating point differ from each other by rounding, relative to them, is printed as 0.
_ZERO = 1e-12
# Stands for a space at which no line ends.
_UNBROKEN = "\N{NO-BREAK SPACE}"
_WITHOUT = ("no disturbance acts on the plant", "the sensors measure without noise", "the first estimate is exact")
_NOISES = ("disturbances", "sensor noise", "the first error")
# An unstable plant that nobody holds runs away no further than this many half-widths: what lies beyond ends in NaN.
FARTHEST = 1e30
# What identifies a plant, beside its sets.
_NUMBERS = (
    *("A", "B", "H", "dt", "box", "box_ends", "input_ends", "mixed_rows", "mixed_ends"),
    *("operating_state", "operating_input", "step_offset"),
)
# In their place stands what proofs keep.
_KEPT = {"box_ends": "kept_ends", "mixed_rows": "step_rows", "mixed_ends": "step_ends"}
_FORMAT = "ncs-gym plant 2"
_VALUES: dict[str, type] = {"model": Model, "limits": Limits, "bounds": Bounds}


@dataclass(frozen=True, eq=False, repr=False)
class LinearPlant(LimitValues):
    """x+ = A x + B u + d, y = H x + v, with limits and bounds (docs/shield_proof.md).

    States and inputs are deviations from an operating point: that of the model, which the middle of a disturbance moves
    to where it rests. Past inputs are the last states if inputs take effect late or their change is limited. What
    follows from its limits is listed by `LimitValues`. `dataclasses.replace` makes another plant.

    Attributes:
        model: The equations.
        limits: Of states and inputs, in the model's units.
        bounds: Each a sum of sets.
        labels: Names of states and inputs with their units, {"states": {"angle": "rad"}, "inputs": {"voltage": "V"}}.
        region: Digest of the model and the limits, which a remainder belongs to.
        fingerprint: SHA-256 over every number that proofs and simulations take of it, the same on every machine.
        state_names, state_units, input_names, input_units: The labels, with defaults.
        dt, between_samples: Those of the model and the limits.
        kept_ends: Ends of `box` that proofs keep at the sampling instants, shape (2, k): `box_ends`, or closer ones
            where the box counts between samples, too.
        arriving: rho of each row of the box, shape (k,): the part of that which is due to the disturbance of a step.
        step_rows, step_ends: Limits of (x, u) at the beginning of a step that proofs keep, shapes (g, n + m) and (2,
            g): the mixed ones, and rows of the box at the other times of the step, by time.
        within_step: Rows of the box at these times, given (x, u, x+) of a step, shape (g - q, 2 n + m).
        n, m, p: Number of states, inputs and outputs.
        of_disturbance, of_sensor, of_first_error: What is declared of each; other attributes name parts of these.
        remainder: What the model leaves out of the process that really moves; None if nothing.
        members: The `Family` of which it is the middle; None for a plant that stands for itself.
        delta: Probability that Gaussian noise is truncated at.

    Raises:
        ValueError: If the values do not fit each other.
    """

    model: Model
    limits: Limits
    bounds: Bounds
    labels: Mapping[str, Any] | None = None
    region: str = field(init=False)
    fingerprint: str = field(init=False)
    state_names: tuple[str, ...] = field(init=False)
    state_units: tuple[str, ...] = field(init=False)
    input_names: tuple[str, ...] = field(init=False)
    input_units: tuple[str, ...] = field(init=False)
    n: int = field(init=False)
    m: int = field(init=False)
    p: int = field(init=False)
    of_disturbance: Source = field(init=False)
    of_sensor: Source = field(init=False)
    of_first_error: Source = field(init=False)
    remainder: Any = field(init=False)
    members: Any = field(init=False)
    kept_ends: np.ndarray = field(init=False)
    arriving: np.ndarray = field(init=False)
    step_rows: np.ndarray = field(init=False)
    step_ends: np.ndarray = field(init=False)
    within_step: np.ndarray = field(init=False)
    delta: float = field(init=False)
    dt = setting("dt", "model.dt")
    between_samples = setting("between_samples", "limits.between_samples")
    gamma = setting("gamma", "of_disturbance.ball")
    process_noise = setting("process_noise", "of_disturbance.noise")
    sensor_noise = setting("sensor_noise", "of_sensor.noise")
    initial_noise = setting("initial_noise", "of_first_error.noise")

    def __post_init__(self) -> None:
        for name, kind in _VALUES.items():
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} must be a {kind.__name__}, got {shown(getattr(self, name))}")
        model, n = self.model, len(self.model.A)
        sums = self.bounds.sums(n, len(model.H))
        declared, rest = sums[0].declared, self.limits.around(model).at_rest(sums[0].declared.sized(n))
        region = model.A, model.B, model.dt, rest.box, *rest.box_ends, rest.input_ends
        region += rest.mixed_rows, *rest.mixed_ends
        self._set(bounds=Bounds(*sums), remainder=None, members=None, region=_digest(enumerate(region)))
        whole = rest.with_past_inputs(model.delays, self.limits.change_within(rest.input_half))
        self._set(**vars(whole), n=len(whole.A), m=whole.B.shape[1], p=len(whole.H))
        self._declare([declared, *sums[1:]], rest)
        self._name()
        self._set(kept_ends=self.box_ends, arriving=np.zeros(len(self.box)))
        self._set(step_rows=self.mixed_rows, step_ends=self.mixed_ends, within_step=np.empty((0, 2 * self.n + self.m)))
        if self.between_samples is not None:
            self._set(**kept_at_all_times(self))
        if owned := [each.of_plant(self) for each in sums[0].parts if each.is_left_out]:
            disturbance = Sum((*declared.parts, *owned))
            self._set(remainder=owned[0], members=owned[0].family, bounds=replace(self.bounds, disturbance=disturbance))
        self._set(fingerprint=self.digest())

    def _declare(self, sums: list[Sum], rest: LimitValues) -> None:
        n, past = len(rest.A), self.past
        weight = weight_of(rest.box, np.zeros(n))
        disturbance = Source.of(sums[0], weight, past, keeps_ball=True)
        if rest.lacking.any():  # twice that is held, in units of the rows
            shape = np.zeros((n, n)) if disturbance.bound is None else disturbance.bound.shape_matrix[:n, :n]
            gram, lacking = exact.product(rest.box.T, rest.box), np.diag(n * np.square(2.0 * rest.lacking))
            held = outer_sum(shape, lacking, gram + np.eye(n) * np.trace(gram) / n)
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
        """Limits, bounds and assumptions for people, with units."""
        sizes = ", ".join(counted(*each) for each in ((self.n, "state"), (self.m, "input"), (self.p, "output")))
        radius = f"spectral radius {self.spectral_radius:.6g}"
        unstable = f"not stable ({radius}): a certificate needs a contract of the channel"
        k, together = len(self.box), len(self.box) + self.m
        lines = {
            "linear plant": [f"{sizes}, a step every {self.dt:g} s"],
            "dynamics": [f"stable ({radius})" if self.spectral_radius < 1.0 else unstable],
            "safe box": [row_limit(self, j) for j in np.flatnonzero(~self.is_past_row).tolist()],
            "input limits": [row_limit(self, j) for j in range(k, together)],
            "both together": [row_limit(self, j) for j in range(together, together + len(self.mixed_rows))],
        }
        if longest := int(self.model.delays.max()):
            up_to = "up to " if np.ptp(self.model.delays) else ""
            lines["input limits"].append(f"inputs take effect {up_to}{counted(longest, 'step')} later")
        own = self.n - self.past  # past inputs are known, and their rows limit nothing: inputs have limits
        states = self.state_names[:own], self.state_units[:own]
        outputs = of_outputs(self.H, self.state_names), of_outputs(self.H, self.state_units, "")
        declared = self.bounds.disturbance, self.bounds.sensor, self.bounds.first_error
        titles = "disturbance", "sensor noise", "first error"
        for title, each, (names, units) in zip(titles, declared, (states, outputs, states), strict=True):
            bound, axes = each.sized(len(names)), np.eye(len(names))
            half, middle = np.broadcast_arrays(bound.support(axes), bound.middle, axes[0])[:2]
            parts = [
                f"{name} {f'from {low:.4g} to' if low + high else 'up to'} {_sized(high, unit)}".replace(" ", _UNBROKEN)
                for name, low, high, unit in zip(names, middle - half, middle + half, units, strict=True)
            ]
            lines[title] = [", ".join(parts)]
        lines["assumptions"], found, indent = [*self.assumptions], [], " " * _INDENT
        for title, texts in lines.items():
            found += [fill(text, _WIDTH, initial_indent=indent, subsequent_indent=indent) for text in texts]
            if texts:
                found[-len(texts)] = f"{title:<{_INDENT}}{found[-len(texts)][_INDENT:]}"
        return "\n".join(found).replace(_UNBROKEN, " ")

    @property
    def assumptions(self) -> tuple[str, ...]:
        """What a certificate takes for granted beyond numbers, in sentences."""
        held = self.nominal_disturbance, self.nominal_sensor_error, self.nominal_initial_error
        without = [text for text, each in zip(_WITHOUT, held, strict=True) if not each.shape_matrix.any()]
        assumed = [f"It is assumed that {text}." for text in without]
        noises = self.process_noise, self.sensor_noise, self.initial_noise
        if truncated := [name for name, each in zip(_NOISES, noises, strict=True) if each.covariance.any()]:
            kept = f"{100.0 * (1.0 - self.delta):.6g} % (delta = {self.delta:g}) of {', '.join(truncated)}"
            assumed.append(f"Gaussian noise is truncated: the bounds hold {kept}, not the rest.")
        if self.remainder is not None:
            assumed.append(self.remainder.sentence)
        if self.between_samples is not None:
            times = f"at {self.between_samples} of each step, and bounded between them"
            own = "what disturbances have done by any time within a step respects the bound of a whole step"
            assumed.append(f"The safe box counts at all times, {times}: {own}.")
        return tuple(assumed)

    def __repr__(self) -> str:
        """Short, since messages and settings of others contain it."""
        return f"<LinearPlant: n={self.n}, m={self.m}, p={self.p}, fingerprint {self.fingerprint[:16]}>"

    @cached_property
    def is_symmetric(self) -> bool:
        """Whether the limits are |c_j x| <= 1 and |u_i| <= u_max_i, and no others."""
        low, high = np.concatenate([self.box_ends, self.input_ends], axis=1)
        units = high[: len(self.box)] == 1.0
        return bool(units.all()) and np.array_equal(-low, high) and not len(self.step_rows)

    @cached_property
    def state_limit(self) -> np.ndarray:
        """Where a simulation stops a state that runs away, shape (n,); infinite for a stable plant."""
        return read_only(FARTHEST * self.half_widths if self.spectral_radius >= 1.0 else np.full(self.n, np.inf))

    @cached_property
    def remainder_bound(self) -> Ellipsoid | None:
        """What holds the remainder, with past inputs."""
        return self.remainder and Ellipsoid(np.pad(self.remainder.bound.shape_matrix, (0, self.past)))

    @cached_property
    def weight(self) -> np.ndarray:
        """Positive definite W, shape (n, n), that measures ellipsoids in units of the safe box: C'C, regularized."""
        return read_only(weight_of(self.box, self.reach_from_rest))

    @cached_property
    def reach_from_rest(self) -> np.ndarray:
        """How far inputs take each state in n steps, from about as far as noise does in one, shape (n,)."""
        sources = self.of_disturbance, self.of_first_error
        bounded = [each.shape_matrix for source in sources for each in source.bounded()]
        noise = [np.diag(each) for each in [*(source.noise.covariance for source in sources), *bounded]]
        return read_only(reach_in_steps(self.A, self.B, self.largest_input, np.sqrt(np.sum(noise, axis=0))))

    @cached_property
    def _box_shape(self) -> np.ndarray:
        return exact.inverse(self.weight)

    @cached_property
    def relative_weight(self) -> np.ndarray:
        """W in units of its largest entry: the identity exactly if the box is a cube."""
        return read_only(self.weight / self.weight.max())

    @cached_property
    def half_widths(self) -> np.ndarray:
        """Half-widths of the ellipsoid {x : x'Wx <= 1}, shape (n,)."""
        return read_only(np.sqrt(np.diag(self._box_shape)))

    @cached_property
    def disturbance(self) -> Ellipsoid:
        """D: holds declared disturbances, truncated process noise, remainder and rounding of a simulation.

        It holds `allowed_disturbance` plus E(F), F = n diag(r^2), with r the rounding of A x + B u + d for x up to
        SIMULATED_REACH half-widths out: (1+s/4) allowed + (1+4/s) F, s the inflation.
        """
        return Ellipsoid(inflated(self.nominal_disturbance.shape_matrix) + self._rounding_margin)

    @cached_property
    def allowed_disturbance(self) -> Ellipsoid:
        """What a disturbance may use of D: the rest is for the rounding of a simulation."""
        nominal = self.nominal_disturbance.shape_matrix
        return Ellipsoid(0.5 * (nominal + inflated(nominal)) + 0.5 * self._rounding_margin)

    @cached_property
    def _rounding_margin(self) -> np.ndarray:
        reach = SIMULATED_REACH * self.half_widths
        rounding = exact.product(np.abs(self.A), reach) + exact.product(np.abs(self.B), self.largest_input) + reach
        rounding *= (self.n + self.m + 2) * np.finfo(float).eps
        return THINNEST * self._box_shape + 10.0 * self.n / (INFLATION - 1.0) * np.diag(np.square(rounding))

    @cached_property
    def nominal_disturbance(self) -> Ellipsoid:
        """D before inflation: extremal disturbances drawn here stay inside E(D) when rounded."""
        return self.of_disturbance.around(self.relative_weight, self.remainder_bound)

    @cached_property
    def nominal_sensor_error(self) -> Ellipsoid:
        """Holds the sensor noise v before inflation."""
        return self.of_sensor.around(np.eye(self.p))

    @cached_property
    def sensor_error(self) -> Ellipsoid:
        """Holds the sensor noise v, without the channel's quantizer (see `sensor_error_with`)."""
        return Ellipsoid(inflated(self.nominal_sensor_error.shape_matrix))

    def sensor_error_with(self, quantization_step: float) -> Ellipsoid:
        """Returns N: sensor noise plus the ball of squared radius p q^2/4 around a quantizer's box."""
        ball = Ellipsoid(self.p * quantization_step**2 / 4.0 * np.eye(self.p))
        return Ellipsoid(inflated(ellipsoid_around_sum(np.eye(self.p), ball, self.nominal_sensor_error).shape_matrix))

    @cached_property
    def nominal_initial_error(self) -> Ellipsoid:
        """Holds the error of the first estimate before inflation."""
        return self.of_first_error.around(self.relative_weight)

    @cached_property
    def initial_error(self) -> Ellipsoid:
        """Holds the error of the first estimate, with slack for rounding."""
        return Ellipsoid(inflated(self.nominal_initial_error.shape_matrix) + self.estimate_rounding)

    @cached_property
    def estimate_rounding(self) -> np.ndarray:
        """Room for the rounding of x_hat up to SIMULATED_REACH half-widths out, shape (n, n), next to an inflation."""
        rounding = 4.0 * np.finfo(float).eps * SIMULATED_REACH * self.half_widths
        return read_only(2.0 * self.n / (INFLATION - 1.0) * np.diag(np.square(rounding)))

    def worst_constraint_values(self, state: np.ndarray, u: np.ndarray, x_next: np.ndarray) -> np.ndarray:
        """Returns the largest `constraint_values` of a step after its beginning, then its `mixed_values`.

        Shape (k + q,) or (k + q, N), for x, x+ of shape (n,) or (n, N) and the input that was held, (m,) or (m, N).
        """
        values = self.constraint_values(x_next)
        if len(self.within_step):
            reached = self.within_step.dot(np.concatenate([state, u, x_next])).reshape(-1, *values.shape)
            low, high = self.box_ends if values.ndim == 1 else self.box_ends[:, :, None]
            values = np.maximum(np.maximum(reached.max(axis=0) - high, low - reached.min(axis=0)), values)
        return np.concatenate([values, self.mixed_values(state, u)]) if len(self.mixed_rows) else values

    def digest(self) -> str:
        """Returns what the fingerprint would be if it were computed now."""
        numbers: list[tuple[Any, Any]] = [(name, getattr(self, _KEPT.get(name, name))) for name in _NUMBERS]
        for number, (ball, noise, bound) in enumerate((self.of_disturbance, self.of_sensor, self.of_first_error)):
            shape = None if bound is None or not bound.shape_matrix.any() else bound.shape_matrix
            energy = noise.energy if noise.covariance.any() else 0.0
            numbers += [(f"set {number}", part) for part in (ball, noise.covariance, energy, shape) if part is not None]
        if self.remainder is not None:
            numbers += self.remainder.numbers
        return _digest(numbers)


def _digest(numbers: Iterable[tuple[Any, Any]]) -> str:
    """Returns the SHA-256 of arrays with their names, in which 0 and -0 are the same."""
    digest = hashlib.sha256()
    for name, value in numbers:
        array = np.asarray(value, dtype="<f8") + 0.0
        digest.update(f"{name}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def row_limit(plant: LinearPlant, j: int) -> str:
    """Returns what limit j of the safe box, the inputs and both together says; that of a sum in its largest entry."""
    n, m = plant.n, plant.m
    rows = [np.pad(plant.box, ((0, 0), (m, 0))), np.eye(m, m + n), np.roll(plant.mixed_rows, m, axis=1)]
    ends = np.concatenate([plant.box_ends, plant.input_ends, plant.mixed_ends], axis=1)
    row, names = np.concatenate(rows)[j], plant.input_names + plant.state_names
    limited, center = np.flatnonzero(row).tolist(), np.concatenate([plant.operating_input, plant.operating_state])
    size, unit = np.abs(row).max(), ""
    if len(limited) == 1:
        size, unit = row[limited[0]], (plant.input_units + plant.state_units)[limited[0]]
    factors = [(row[i] / size, names[i]) for i in limited]
    terms = [("- " if each < 0.0 else "+ ") + f"{abs(each):.4g} ".removeprefix("1 ") + name for each, name in factors]
    name = " ".join(terms).removeprefix("+ ")
    name = f"-{name[2:]}" if name.startswith("- ") else name
    (low, high), center = sorted((ends[:, j] / size).tolist()), float(row @ center / size)
    center *= abs(center) > _ZERO * max(end for end in (-low, high) if end < np.inf)
    if center == 0.0 and low == -high:
        return f"|{name}| <= {_sized(high, unit)}"
    point = f" (operating point {center:.6g})" if center else ""
    bottom, top = (0.0 if abs(center + end) <= _ZERO * abs(center) else center + end for end in (low, high))
    left = "" if np.isinf(low - high) else f"{bottom:.6g} <= "
    right = f">= {_sized(bottom, unit)}" if high == np.inf else f"<= {_sized(top, unit)}"
    return f"{left}{name} {right}{point}"


def _sized(size: float, unit: str) -> str:
    return f"{size:.4g} {unit}".rstrip()


def of_outputs(H: np.ndarray, of_states: Sequence[str], otherwise: str = "y{}") -> list[str]:
    """Returns names, or units, of outputs: those of states that are measured alone, else y1, y2, ..."""
    alone = (np.abs(H).sum(axis=1) == 1.0) & (H.max(axis=1) == 1.0)
    return [str(of_states[row.argmax()]) if alone[j] else otherwise.format(j + 1) for j, row in enumerate(H)]
