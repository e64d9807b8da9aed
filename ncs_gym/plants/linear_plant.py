"""The linear plant: its equations, its limits, and what is declared of everything uncertain about it."""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np

from ncs_gym import exact
from ncs_gym.plants import between_samples, limits, plant_file, statespace
from ncs_gym.plants.assumptions import assumptions_of, warn_of_no_noise
from ncs_gym.plants.description import described
from ncs_gym.plants.family import bound_of_family, plant_of_middle
from ncs_gym.plants.hard_bounds import HardBounds
from ncs_gym.plants.limit_values import LimitValues
from ncs_gym.plants.past_inputs import inputs_under_way, storing, with_past_inputs
from ncs_gym.uncertainty.declared_bound import as_bound
from ncs_gym.uncertainty.ellipsoid import Ellipsoid, ellipsoid_around_sum
from ncs_gym.uncertainty.family import Family
from ncs_gym.uncertainty.remainder import Remainder
from ncs_gym.uncertainty.truncated_gaussian import (
    SMALLEST_DELTA,
    SMALLEST_KEPT,
)
from ncs_gym.validation import (
    FILLED_IN_LATER,
    SMALLEST_NUMBER,
    as_count,
    as_covariance,
    as_matrix,
    as_names,
    as_number,
    as_setting,
    as_units,
    counted,
    read_only,
    reason_of,
    shown,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ncs_gym.uncertainty.declared_bound import Bound

# An unstable plant that nobody holds runs away no further than this many half-widths: what lies beyond ends in NaN.
FARTHEST = 1e30
# Disturbances of a step of a model whose response to a constant is worse conditioned are not traced back to its cause.
LARGEST_CONDITION = 1e9
# Arguments of the constructor about limits, in this order: those that are fields, too, need not be given.
_LIMITS = (
    *("state_limits", "input_limits", "output_limits", "mixed_limits", "input_delay", "du_max", "box", "u_max"),
    *("offset", "input_ends", "box_ends", "mixed_rows", "mixed_ends"),
)


Kind = TypeVar("Kind", bound=type)


def with_limits_as_published(kind: Kind) -> Kind:
    """Makes a constructor take limits as they are published, and say what to give for C=.

    C= is limits to some people, and an output matrix to others.
    """
    constructor: Any = kind
    construct: Callable[..., None] = constructor.__init__

    @functools.wraps(construct)
    def __init__(self: Any, **arguments: Any) -> None:
        if "C" in arguments:
            raise ValueError(
                "C= is not an argument: pass box=... for the limits |c_j x| <= 1 (rows, or half-widths of the states), "
                "H=... for the output matrix of a state-space model"
            )
        input_delay, du_max = (arguments.pop(name, None) for name in ("input_delay", "du_max"))
        if not (input_delay is None and du_max is None):  # a plant of more states
            larger = with_past_inputs(kind(**arguments), input_delay, du_max)
            arguments = {each.name: getattr(larger, each.name) for each in fields(larger)}
        if all(each.name in arguments for each in fields(kind)):  # of `dataclasses.replace`
            box, ends = as_setting(arguments["box"]), arguments["box_ends"]
            are_kept = isinstance(ends, np.ndarray) and not ends.flags.writeable
            if box is not None and box.ndim == 1 and are_kept:  # new half-widths, and ends of the rows before
                arguments["box_ends"] = None
        else:
            limits.require_given_once(arguments)
        construct(self, **limits.fields_of(arguments))

    of_fields = dict(inspect.signature(construct).parameters)
    first = {name: of_fields[name] for name in ("self", "A", "B", "dt")}
    of_limits = {name: inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None) for name in _LIMITS}
    others = {name: each for name, each in of_fields.items() if name not in of_limits}
    __init__.__signature__ = inspect.Signature([*(first | of_limits | others).values()])  # pyright: ignore
    constructor.__init__ = __init__
    return kind


@with_limits_as_published
@dataclass(frozen=True, eq=False, kw_only=True)
class LinearPlant(LimitValues, HardBounds):
    """x+ = A x + B u + d, y = H x + v, with limits and bounds (docs/shield_proof.md).

    All of it is in deviations from an operating point, (0, 0) unless given, except the limits of the constructor, which
    are absolute. A and B are a model of deviations, as linearization gives; of a model in absolute coordinates,
    x+ = A x + B u + c, give c as `offset`: then the operating point has to be an equilibrium.

    What is declared of the uncertainties adds up: `disturbance_bound`, `sensor_bound` and `initial_bound` bound d, v
    and the error of the first estimate in the plant's units, each a number r (a ball), half-widths per entry (a box),
    an `Ellipsoid`, or a pair (E, w) for d = E w with |w_i| <= w_i; 0 says on purpose that there is none. Covariances
    are the other way in: they describe Gaussian noise that is *truncated*, so that the bounds, and every certificate,
    hold the fraction 1 - delta of it alone. Of noise with a datasheet's covariance a fraction delta of all samples lies
    outside.

    Args:
        state_limits: Pair (low, high) around `operating_state`, each a number or shape (n,), infinite where there is no
            limit. `box` is the short form of symmetric ones: half-widths of the states, shape (n,), infinite where
            there is no limit, or rows c_j with |c_j x| <= 1, shape (k, n).
        input_limits: Pair (low, high) around `operating_input`, each a number or shape (m,). `u_max`, a positive number
            or shape (m,), is the short form of |u_i| <= u_max_i.
        output_limits: Further limits, a list of (row, low, high) with low <= row x <= high.
        mixed_limits: Limits of states and inputs together, of outputs with feedthrough and of coupled inputs, a list of
            (state row, input row, low, high) with low <= state row x + input row u <= high for the x at the beginning
            of a step and the u that is held then.
        input_delay: Steps after which an input takes effect. The inputs under way become further states, which the
            estimator knows; everything else is given for the model's own states.
        du_max: Largest change of each input from one step to the next, a positive number or shape (m,): the plant gets
            past inputs as further states (`with_rate_limits`).
        offset: c of a model in absolute coordinates, shape (n,).

    Attributes:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        box: Rows c_j of the safe box, shape (k, n), in units of half the range that is allowed; where one end is open,
            the other one is 1 unit away.
        box_ends: The low and the high ends of c_j x, shape (2, k); -1 and 1 where limits are symmetric, infinite where
            there is none.
        input_ends: The low and the high ends of the inputs, shape (2, m).
        mixed_rows: Rows of limits on (x, u) at the beginning of a step, shape (q, n + m), in units as those of `box`;
            q = 0 for none.
        mixed_ends: Their low and high ends, shape (2, q).
        dt: Duration of a step [s].
        gamma: Squared radius of the unknown disturbance, d'd <= gamma.
        H: Output matrix, shape (p, n); the identity by default.
        process_noise_cov: Q, shape (n, n), truncated at chi2_{n,1-delta}; zero by default.
        measurement_noise_cov: R, shape (p, p), truncated at chi2_{p,1-delta}; zero by default.
        initial_cov: P0 of the first estimate, shape (n, n), truncated alike; zero by default.
        delta: Probability mass that the truncation of each Gaussian removes, in [1e-12, 0.999].
        disturbance_bound: Of further disturbances d; kept as an `Ellipsoid`. A triple (E, low, high) for d = E w with
            low <= w <= high moves the operating point to where the middle of w rests: deviations are counted from it.
        sensor_bound: Of further sensor noise v; kept as an `Ellipsoid`.
        initial_bound: Of a further error of the first estimate; kept as an `Ellipsoid`.
        remainder: What the model leaves out of the process that really moves, part of d (`ncs_gym.linear_model`,
            `family`); None if nothing.
        continuous_model: [Ac, Bc] of the model x' = Ac x + Bc u in continuous time that A and B were sampled from,
            shape (n, n + m) [1/s]; None if it is unknown.
        between_samples: Number N of times per step, 2 to 64, at which the box counts: environments look there, and
            certificates, with a bound on what is between them, keep it at all times (docs/shield_proof.md), if what
            disturbances have done by any time of a step respects the bound of a whole step. None, or 1: at the sampling
            instants alone. Needs a continuous model without remainder and a box that bounds every state.
        operating_state: State that deviations are counted from, shape (n,); for conversion and text.
        operating_input: Input that deviations are counted from, shape (m,).
        step_offset: Sizes of what the operating point rests under in every step beside A and B, shape (n,): |offset|
            and |E| |middle| of a disturbance with two ends, which do not cancel. Zero with `between_samples`, since how
            much of either has come by a time within a step is not known.
        state_names: Names of the states, for tables and figures.
        state_units: Units of the states.
        input_names: Names of the inputs.
        input_units: Units of the inputs.

    Raises:
        ValueError: If a matrix has a wrong shape, is not finite or not a covariance, a bound is negative, or the
            operating point is not strictly between the limits.
    """

    A: np.ndarray
    B: np.ndarray
    dt: float
    box: np.ndarray
    input_ends: np.ndarray
    box_ends: np.ndarray = FILLED_IN_LATER
    mixed_rows: np.ndarray = FILLED_IN_LATER
    mixed_ends: np.ndarray = FILLED_IN_LATER
    gamma: float = 0.0
    H: np.ndarray = FILLED_IN_LATER
    process_noise_cov: np.ndarray = FILLED_IN_LATER
    measurement_noise_cov: np.ndarray = FILLED_IN_LATER
    initial_cov: np.ndarray = FILLED_IN_LATER
    delta: float = 0.05
    disturbance_bound: Ellipsoid | None = None
    sensor_bound: Ellipsoid | None = None
    initial_bound: Ellipsoid | None = None
    remainder: Remainder | None = None
    continuous_model: np.ndarray | None = None
    between_samples: int | None = None
    operating_state: np.ndarray = FILLED_IN_LATER
    operating_input: np.ndarray = FILLED_IN_LATER
    step_offset: np.ndarray = FILLED_IN_LATER
    state_names: Sequence[str] = field(default=())
    state_units: Sequence[str] = field(default=())
    input_names: Sequence[str] = field(default=())
    input_units: Sequence[str] = field(default=())

    if TYPE_CHECKING:
        # The fields say what is kept; the constructor takes whatever `__post_init__` can turn into that.
        def __init__(
            self,
            *,
            A: ArrayLike,
            B: ArrayLike,
            dt: float,
            state_limits: tuple[ArrayLike, ArrayLike] | None = None,
            input_limits: tuple[ArrayLike, ArrayLike] | None = None,
            output_limits: Sequence[tuple[ArrayLike, float, float]] | None = None,
            mixed_limits: Sequence[tuple[ArrayLike, ArrayLike, float, float]] | None = None,
            input_delay: int | None = None,
            du_max: ArrayLike | None = None,
            box: ArrayLike | None = None,
            u_max: ArrayLike | None = None,
            offset: ArrayLike | None = None,
            input_ends: ArrayLike | None = None,
            box_ends: ArrayLike | None = None,
            mixed_rows: ArrayLike | None = None,
            mixed_ends: ArrayLike | None = None,
            gamma: float = 0.0,
            H: ArrayLike | None = None,
            process_noise_cov: ArrayLike | None = None,
            measurement_noise_cov: ArrayLike | None = None,
            initial_cov: ArrayLike | None = None,
            delta: float = 0.05,
            disturbance_bound: Bound | None = None,
            sensor_bound: Bound | None = None,
            initial_bound: Bound | None = None,
            remainder: Remainder | None = None,
            continuous_model: ArrayLike | None = None,
            between_samples: int | None = None,
            operating_state: ArrayLike | None = None,
            operating_input: ArrayLike | None = None,
            step_offset: ArrayLike | None = None,
            state_names: Sequence[str] = (),
            state_units: Sequence[str] = (),
            input_names: Sequence[str] = (),
            input_units: Sequence[str] = (),
        ) -> None: ...

    def __post_init__(self) -> None:
        A = as_matrix(self.A, (None, None), "A")
        n = A.shape[0]
        self._set("A", as_matrix(A, (n, n), "A"))
        self._set("B", as_matrix(self.B, (n, None), "B"))
        self._set("box", limits.as_box_rows(self.box, n))
        self._set("H", np.eye(n) if self.H is None else as_matrix(self.H, (None, n), "H"))
        if (np.abs(self.H).max(axis=1) < SMALLEST_NUMBER).any():
            raise ValueError(f"every row of H must measure something, got {shown(self.H.tolist())}")
        self._set("box_ends", limits.as_row_ends(self.box_ends, len(self.box)))
        self._set("input_ends", limits.as_input_ends(self.input_ends, self.m))
        self._set("mixed_rows", limits.as_mixed_rows(self.mixed_rows, n + self.m))
        self._set("mixed_ends", limits.as_row_ends(self.mixed_ends, len(self.mixed_rows), "mixed_ends"))
        self._set("dt", as_number(self.dt, "dt", low=0.0, low_open=True))
        is_given = self._check_declared()
        self._set("step_offset", limits.as_operating_point(self.step_offset, n, "step_offset"))
        self._check_between_samples()
        for name, size, letter in (("state", n, "x"), ("input", self.m, "u")):
            center = f"operating_{name}"
            self._set(center, limits.as_operating_point(getattr(self, center), size, center))
            names = tuple(f"{letter}{i + 1}" for i in range(size))
            self._set(f"{name}_names", as_names(getattr(self, f"{name}_names"), names, f"{name}_names"))
            self._set(f"{name}_units", as_units(getattr(self, f"{name}_units"), size, f"{name}_units"))
            if len(set(getattr(self, f"{name}_names"))) < size:
                raise ValueError(f"{name}_names must differ, got {shown(getattr(self, f'{name}_names'))}")
        self._make_arrays_read_only()
        warn_of_no_noise(is_given)

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _check_declared(self) -> tuple[bool, bool, bool]:
        """Checks what is declared of disturbances, sensor noise and first estimate; returns for which anything is."""
        self._set("gamma", as_number(self.gamma, "gamma", low=0.0))
        self._set("delta", as_number(self.delta, "delta", low=SMALLEST_DELTA, high=1.0 - SMALLEST_KEPT))
        declared = (
            ("process_noise_cov", "disturbance_bound", self.n),
            ("measurement_noise_cov", "sensor_bound", self.p),
            ("initial_cov", "initial_bound", self.n),
        )
        is_given = [any(getattr(self, name) is not None for name in names) for *names, _ in declared]
        for covariance, bound, size in declared:
            value = getattr(self, covariance)
            self._set(covariance, np.zeros((size, size)) if value is None else as_covariance(value, size, covariance))
            if (value := getattr(self, bound)) is not None:
                self._set(bound, as_bound(value, size, bound))
        if self.remainder is not None:
            self._set("remainder", self._own_remainder(self.remainder))
        return is_given[0] or self.gamma > 0.0 or self.remainder is not None, is_given[1], is_given[2]

    def _own_remainder(self, given: Any) -> Remainder:
        """Returns the remainder of this model; the bound of a family's is worked out from its members."""
        family = given.family if isinstance(given, Remainder) else given
        if isinstance(family, Family):
            return Remainder(bound_of_family(self, family), True, family.basis, family)
        if not isinstance(given, Remainder):
            raise ValueError(f"remainder must be a Remainder or a Family, got {shown(given)}")
        as_bound(given.bound, self.n, "remainder")
        model = {name: getattr(self, name) for name in ("A", "B")}
        model |= {"box": np.vstack([self.box.T, self.box_ends]), "u_max": self.input_ends, "dt": self.dt}
        model["mixed_limits"] = np.vstack([self.mixed_rows.T, self.mixed_ends]).T
        return given.of_model(model)

    def _check_between_samples(self) -> None:
        """Raises ValueError unless the model in continuous time is one, and there if times between samples count."""
        if self.continuous_model is not None:
            shape = (self.n, self.n + self.m)
            self._set("continuous_model", as_matrix(self.continuous_model, shape, "continuous_model"))
            widths = np.concatenate([self.half_widths, self.input_half])
            between_samples.require_model_of(self.continuous_model, self.A, self.B, self.dt, widths)
        if self.between_samples is None:
            return
        points = as_count(self.between_samples, "between_samples", low=1, high=between_samples.MOST_POINTS)
        self._set("between_samples", points if points > 1 else None)
        if points == 1:
            return
        if self.continuous_model is None:
            raise ValueError(
                "between_samples needs a plant that was sampled from a model in continuous time "
                "(LinearPlant.from_statespace); plants that model another process have none"
            )
        if self.remainder is not None:
            raise ValueError(
                "between_samples is for a plant without a remainder, which says nothing of the times between samples"
            )
        if self.step_offset.any():
            raise ValueError(
                "between_samples is for an operating point that rests without a constant disturbance: how much of "
                f"{shown(self.step_offset.tolist())} per step has come by a time within a step is not known"
            )
        if exact.rank(self.box[np.isfinite(self.box_ends).all(axis=0)]) < self.n:
            raise ValueError("between_samples needs a box that bounds every state: give it rows with generous limits")

    @classmethod
    def from_statespace(
        cls,
        sys: Any,
        dt: float | None = None,
        **settings: Any,
    ) -> Self:
        """Returns the plant of a state-space model; its C becomes H.

        Args:
            sys: A state-space model of python-control or scipy.signal, or a tuple (A, B, C, D) in continuous or
                (A, B, C, D, dt) in discrete time. A model in continuous time is sampled exactly, by zero-order hold.
            dt: Duration of a step [s], needed unless the model has one.
            settings: Other arguments of `LinearPlant` except A, B and H; limits at least.

        Raises:
            ValueError: If D is not zero, dt is missing or another than the model's, or an argument is wrong.
        """
        return cls(**statespace.sampled_arguments(sys, dt, settings))

    @classmethod
    def family(
        cls,
        members: Sequence[Self] | Callable[..., Self],
        ranges: Mapping[str, tuple[float, float]] | None = None,
        *,
        monotone: bool = False,
        at_rest: bool = False,
    ) -> Self:
        """Returns the plant of the middle of a family, with a proved bound on what it leaves out of any member.

        A certificate for it covers every member, also one that moves from one to another (docs/shield_proof.md, "Plants
        that vary"). An environment draws a member for every episode; what the bound allows is not drawn beside.

        Args:
            members: Two plants or more that differ in A and B alone, and in where they rest, whose convex hull is
                covered: the vertices. Or a function of parameters given by name that returns such plants. Deviations
                of the middle are counted from the middle of their operating points.
            ranges: Lowest and highest value of each parameter of the function, up to 6 of them.
            monotone: Whether every entry of A and B is monotone in each parameter while the others stay, anywhere in
                the ranges. That is yours to prove; it bounds the entries by those of the corners, and is checked on a
                grid. Needed for a function. Where members rest at different points, it is also about A x + B u + c - x
                at the middle of these.
            at_rest: Whether every member is at rest at its own operating point, with c as `offset` in absolute
                coordinates: A x + B u + c = x. Needed where members differ in what acts on operating points that are
                not zero; a model of deviations does not say it.

        Raises:
            ValueError: If members differ in anything else, are proved between samples or have a remainder, a claim of
                monotone entries is contradicted or missing, a state that matters has no limit, or an argument is wrong.
        """
        return plant_of_middle(cls, members, ranges, monotone=monotone, at_rest=at_rest)

    def resampled(self, dt: float) -> LinearPlant:
        """Returns the plant with another duration of a step, which its continuous model knows; itself for the same one.

        Whatever disturbs it is taken to act in continuous time and to be constant during a step: with
        G(dt) = int_0^dt exp(Ac s) ds, the disturbances of a step become G(dt') G(dt)^-1 d. What is declared of sensors
        and of the first estimate stays as it is, and so does `between_samples`: a longer step may need more times.
        Where that is not what disturbs your plant, make the plant anew.

        Raises:
            ValueError: If dt is out of range, the plant has no continuous model, or a remainder, which belongs to its
                step.
        """
        dt = as_number(dt, "dt", low=0.0, low_open=True)
        if abs(dt - self.dt) <= statespace.SAME_STEP * self.dt:
            return self
        if inputs_under_way(self):
            raise ValueError(
                "a plant whose states are past inputs, of input_delay or limits of rates, belongs to its step: make it "
                f"anew by LinearPlant.from_statespace with dt={dt:g}, and the delay or change of its steps"
            )
        if self.continuous_model is None or self.remainder is not None:
            raise ValueError(
                f"only a plant that was sampled from a model in continuous time, without a remainder, can be sampled "
                f"every {dt:g} s: make it by LinearPlant.from_statespace"
            )
        Ac, Bc = self.continuous_model[:, : self.n], self.continuous_model[:, self.n :]
        A, B = statespace.zero_order_hold(Ac, Bc, dt)
        of_constant = [statespace.zero_order_hold(Ac, np.eye(self.n), step)[1] for step in (dt, self.dt)]
        if np.linalg.cond(of_constant[1] * self.half_widths / self.half_widths[:, None]) > LARGEST_CONDITION:
            raise ValueError(f"a step of {self.dt:g} s hides how disturbances act in continuous time: shorten dt")
        G = exact.product(of_constant[0], exact.inverse(of_constant[1]))
        ball = Ellipsoid(self.gamma * np.eye(self.n))
        bound = ellipsoid_around_sum(self.relative_weight, ball, self.disturbance_bound)
        return replace(
            self,
            A=A,
            B=B,
            dt=dt,
            gamma=0.0,
            disturbance_bound=Ellipsoid(_symmetric_product(G, bound.shape_matrix)),
            process_noise_cov=_symmetric_product(G, self.process_noise_cov),
            step_offset=exact.product(np.abs(G), self.step_offset),
        )

    def with_rate_limits(self, du_max: ArrayLike, *, per: str = "step") -> Self:
        """Returns the plant with limits |u_k - u_{k-1}| <= du_max of how fast inputs change.

        The input of the step before becomes a further state, which the estimator knows; where an input delay has made
        it one already, no state is added. An episode begins with the operating input as the one before.

        Args:
            du_max: Largest change of each input, a positive number or shape (m,).
            per: What it is a change per, "step" or "second".

        Raises:
            ValueError: If an argument is wrong, no input can change by as much, the box counts between samples, or the
                plant has an `initial_cov`.
        """
        if per not in ("step", "second"):
            raise ValueError(f"per must be 'step' or 'second', got {shown(per)}")
        change = limits.as_input_limits(du_max, self.m, "du_max") * (self.dt if per == "second" else 1.0)
        if (change >= 2.0 * self.input_half).all():
            raise ValueError(f"du_max = {shown(du_max)} limits nothing: inputs change by no more than their range")
        plant = self if inputs_under_way(self) else storing(self, 1, delay=0)
        rows = np.concatenate([np.zeros((self.m, plant.n - self.m)), -np.eye(self.m), np.eye(self.m)], axis=1)
        rates = limits.Rows(rows / change[:, None], *np.array([[-1.0], [1.0]]) * np.ones(self.m))
        return replace(
            plant,
            mixed_rows=np.concatenate([plant.mixed_rows, rates.rows]),
            mixed_ends=np.concatenate([plant.mixed_ends, [rates.low, rates.high]], axis=1),
        )

    @property
    def document(self) -> dict[str, Any]:
        """What a file of the plant holds, as JSON values: all that it was made with, every number exact."""
        return plant_file.document_of(self)

    @classmethod
    def read(cls, given: Mapping[str, Any] | str | os.PathLike[str]) -> Self:
        """Returns the plant of a `document`, or of the file at a path, checked like any other.

        Raises:
            ValueError: If the file is missing or not that of a plant, or an argument is wrong.
        """
        arguments, name = plant_file.arguments_in(given)
        try:
            return cls(**arguments)
        except TypeError as error:  # an argument is missing or unknown
            raise ValueError(f"{name} is not that of a plant: {reason_of(error)}") from error

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
        return self.B.shape[1]

    @property
    def p(self) -> int:
        """Number of outputs."""
        return self.H.shape[0]

    @cached_property
    def without_remainder(self) -> LinearPlant:
        """The same plant without its remainder: what is declared beside it."""
        return self if self.remainder is None else replace(self, remainder=None)

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
        if len(self.mixed_rows):
            raise ValueError(
                "this plant has limits of states and inputs together, and what was asked for takes only |c_j x| <= 1 "
                f"and |u_i| <= u_max_i (a plant has {instead}, mixed_rows and mixed_ends)"
            )
        if not self.is_symmetric:
            raise ValueError(
                "the limits of this plant are not symmetric about its operating point, and what was asked for takes "
                f"only symmetric ones (a plant has {instead}); symmetric limits inside them are those of `symmetric`"
            )

    @cached_property
    def symmetric(self) -> LinearPlant:
        """The plant with the largest symmetric limits inside its own; itself if these are symmetric.

        Raises:
            ValueError: If there are limits of states and inputs together.
        """
        if self.is_symmetric:
            return self
        if len(self.mixed_rows):
            self._require_symmetric("box_ends and input_ends")
        u_max = np.minimum(-self.input_low, self.input_high)
        given = self.remainder  # bounded for more states and inputs than are left
        remainder = given and (given.family or Remainder(given.bound, given.is_proved, given.basis))
        limits = {"box": self.symmetric_box, "box_ends": None, "input_ends": (-u_max, u_max)}
        return replace(self, **limits, remainder=remainder)

    @cached_property
    def symmetric_box(self) -> np.ndarray:
        """Rows c_j of the largest box |c_j x| <= 1 inside the safe box, shape (k, n)."""
        return read_only(self.box / np.minimum(-self.box_low, self.box_high)[:, None])

    @property
    def members(self) -> Family | None:
        """The members of which it is the middle (`family`); None for a plant that stands for itself."""
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
        """SHA-256 over every number that the plant was declared with, to bind certificates and models to it.

        It is the same on every machine: these numbers are given, or rounded once (`ncs_gym.exact`).
        """
        return self.digest()

    def digest(self) -> str:
        """Returns what the fingerprint would be if it were computed now."""
        digest = hashlib.sha256()
        matrices = {"A": self.A, "B": self.B, "C": self.box, "H": self.H, "u_max": self.input_ends[1]}
        names = ("process_noise_cov", "measurement_noise_cov", "initial_cov")
        for name, array in (matrices | {name: getattr(self, name) for name in names}).items():
            digest.update(f"{name}{array.shape}".encode() + array.astype("<f8").tobytes())
        digest.update(np.array([self.dt, self.gamma, self.delta], dtype="<f8").tobytes())
        if not self.is_symmetric:  # symmetric ones keep the fingerprint they always had
            for name in ("box_ends", "input_ends", *(("mixed_rows", "mixed_ends") if len(self.mixed_rows) else ())):
                array = getattr(self, name)
                digest.update(f"{name}{array.shape}".encode() + array.astype("<f8").tobytes())
        bounds = "disturbance_bound", "sensor_bound", "initial_bound"
        for name in (*bounds, "operating_state", "operating_input", "step_offset"):
            value = getattr(self, name)
            array = value.shape_matrix if isinstance(value, Ellipsoid) else value
            if array is not None and np.any(array):  # a plant without them keeps the fingerprint it always had
                digest.update(name.encode() + array.astype("<f8").tobytes())
        if self.remainder is not None:
            digest.update(
                f"remainder{self.remainder.is_proved}".encode()
                + self.remainder.bound.shape_matrix.astype("<f8").tobytes()
            )
        if self.members is not None:
            digest.update(b"members" + self.members.members.astype("<f8").tobytes())
        if self.between_samples is not None and self.continuous_model is not None:
            digest.update(f"between_samples{self.between_samples}".encode())
            digest.update(self.continuous_model.astype("<f8").tobytes())
        return digest.hexdigest()

    def to_deviation(self, value: ArrayLike, of: str = "state") -> np.ndarray:
        """Returns a physical state, input or output as its deviation from the operating point.

        Args:
            value: Shape (n,), (m,) or (p,), or of many environments (N, n), (N, m) or (N, p).
            of: "state", "input" or "output"; the output at the operating point is H x0.

        Raises:
            ValueError: If `of` is none of these, or the values are no finite vectors of its size.
        """
        center = self._operating_value(of)
        return limits.as_points(value, len(center), f"the {of}") - center

    def from_deviation(self, value: ArrayLike, of: str = "state") -> np.ndarray:
        """Returns the physical state, input or output of a deviation; the inverse of `to_deviation`."""
        center = self._operating_value(of)
        return limits.as_points(value, len(center), f"the {of}") + center

    def _operating_value(self, of: str) -> np.ndarray:
        values = {"state": self.operating_state, "input": self.operating_input, "output": self.H @ self.operating_state}
        if not isinstance(of, str) or of not in values:
            raise ValueError(f"of must be one of {list(values)}, got {shown(of)}")
        return values[of]


def _symmetric_product(G: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Returns G P G'."""
    product = exact.product(G, shape, G.T)
    return 0.5 * (product + product.T)
