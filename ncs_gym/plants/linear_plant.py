"""The linear plant: its equations, its limits, and what is declared of everything uncertain about it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ncs_gym.plants import description, limits, statespace
from ncs_gym.plants.arguments import explains_arguments
from ncs_gym.plants.bounds import FLAT_INFLATION, INFLATION, SIMULATED_REACH, SMALLEST_DELTA, HardBounds
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.remainder import Remainder
from ncs_gym.validation import (
    FILLED_IN_LATER,
    SMALLEST_NUMBER,
    as_matrix,
    as_names,
    as_number,
    read_only,
    shown,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ncs_gym.uncertainty.declared_bound import Bound

__all__ = ["FLAT_INFLATION", "INFLATION", "SIMULATED_REACH", "SMALLEST_DELTA", "LinearPlant"]

# An unstable plant that nobody holds runs away no further than this many half-widths: what lies beyond ends in NaN.
FARTHEST = 1e30


@explains_arguments
@dataclass(frozen=True, eq=False, kw_only=True)
class LinearPlant(HardBounds, limits.OperatingPoint):
    """x+ = A x + B u + d, y = H x + v, with limits and bounds (theory.md section 1).

    All of it is in deviations from an operating point, (0, 0) unless given. What is declared of the uncertainties adds
    up: `disturbance_bound`, `sensor_bound` and `initial_bound` bound d, v and the error of the first estimate in the
    plant's units, each a number r (a ball), half-widths per entry (a box), an `Ellipsoid`, or a pair (E, w) for d = E w
    with |w_i| <= w_i; 0 says on purpose that there is none. Covariances are the other way in: they describe Gaussian
    noise that is *truncated*, so that the bounds, and every certificate, hold the fraction 1 - delta of it alone. Of
    noise with a datasheet's covariance a fraction delta of all samples lies outside.

    Attributes:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        box: The safe box: half-widths of the states, shape (n,) (infinite: no limit), or rows c_j with |c_j x| <= 1,
            shape (k, n). Kept as rows.
        u_max: Input limits |u_i| <= u_max_i, a positive number or shape (m,).
        dt: Duration of a step [s].
        gamma: Squared radius of the unknown disturbance, d'd <= gamma.
        H: Output matrix, shape (p, n); the identity by default.
        process_noise_cov: Q, shape (n, n), truncated at chi2_{n,1-delta}; zero by default.
        measurement_noise_cov: R, shape (p, p), truncated at chi2_{p,1-delta}; zero by default.
        initial_cov: P0 of the first estimate, shape (n, n), truncated alike; zero by default.
        delta: Probability mass that the truncation of each Gaussian removes, in [1e-12, 0.999].
        disturbance_bound: Of further disturbances d; kept as an `Ellipsoid`.
        sensor_bound: Of further sensor noise v; kept as an `Ellipsoid`.
        initial_bound: Of a further error of the first estimate; kept as an `Ellipsoid`.
        remainder: What the model leaves out of the process that really moves, part of d (`ncs_gym.linear_model`); None
            if nothing.
        error_gain: The gain, shape (m, n), whose answers to an estimation error make it costly when error sets by age
            are chosen (docs/contracts.md), a certificate's K in round numbers; a regulator's by default.
        operating_state: State that deviations are counted from, shape (n,); for conversion and text.
        operating_input: Input that deviations are counted from, shape (m,).
        state_names: Names of the states, for tables and figures.
        state_units: Units of the states.
        input_names: Names of the inputs.
        input_units: Units of the inputs.

    Raises:
        ValueError: If a matrix has a wrong shape, is not finite or not a covariance, or a bound is negative.
    """

    A: np.ndarray
    B: np.ndarray
    box: np.ndarray
    u_max: np.ndarray
    dt: float
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
    error_gain: np.ndarray | None = None
    operating_state: np.ndarray = FILLED_IN_LATER
    operating_input: np.ndarray = FILLED_IN_LATER
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
            box: ArrayLike,
            u_max: ArrayLike,
            dt: float,
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
            error_gain: ArrayLike | None = None,
            operating_state: ArrayLike | None = None,
            operating_input: ArrayLike | None = None,
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
        self._set("u_max", limits.as_input_limits(self.u_max, self.m))
        self._set("dt", as_number(self.dt, "dt", low=0.0, low_open=True))
        is_given = self._check_declared()
        if self.error_gain is not None:
            self._set("error_gain", as_matrix(self.error_gain, (self.m, n), "error_gain"))
        for name, size, letter in (("state", n, "x"), ("input", self.m, "u")):
            center = f"operating_{name}"
            self._set(center, limits.as_operating_point(getattr(self, center), size, center))
            names = tuple(f"{letter}{i + 1}" for i in range(size))
            for field_name, default in ((f"{name}_names", names), (f"{name}_units", ("",) * size)):
                self._set(field_name, as_names(getattr(self, field_name), default, field_name))
        self._make_arrays_read_only()
        description.warn_of_no_noise(is_given)

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    @classmethod
    def from_statespace(cls, sys: Any, dt: float | None = None, *, input_delay: int = 0, **settings: Any) -> Self:
        """Returns the plant of a state-space model; its C becomes H.

        Args:
            sys: A model of python-control or scipy.signal, or a tuple (A, B, C, D) in continuous or (A, B, C, D, dt)
                in discrete time. A model in continuous time is sampled exactly, by zero-order hold.
            dt: Duration of a step [s], needed unless the model has one.
            input_delay: Steps after which an input takes effect. The inputs under way become further states, which the
                estimator knows; box, bounds and names are given for the model's own states.
            settings: Other arguments of `LinearPlant` except A, B and H (`box` and `u_max` at least), or those of
                `LinearPlant.around`.

        Raises:
            ValueError: If D is not zero, dt is missing or another than the model's, or an argument is wrong.
        """
        arguments = statespace.sampled_arguments(sys, dt, settings)
        given = {"state_limits", "input_limits"} & set(settings)
        if len(given) == 1:
            raise ValueError(f"{given.pop()} is given alone: give state_limits and input_limits, or box and u_max")
        plant = cls.around(**arguments) if given else cls(**arguments)
        return plant if input_delay == 0 else cls(**statespace.delayed_arguments(plant, input_delay))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Returns the plant in a file of `save`, checked like any other.

        Raises:
            ValueError: If the file is missing or not that of a plant, or an argument is wrong.
        """
        return cls(**description.read_plant(path, cls))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a JSON file in which every number is exact.

        Raises:
            OSError: If the file cannot be written.
        """
        description.write_plant(self, path)

    def __str__(self) -> str:
        return description.describe(self)

    @property
    def assumptions(self) -> tuple[str, ...]:
        """What a certificate takes for granted beyond the numbers of the bounds, in sentences."""
        return description.assumptions_of(self)

    @cached_property
    def without_remainder(self) -> LinearPlant:
        """The same plant without its remainder: what is declared beside it."""
        return self if self.remainder is None else replace(self, remainder=None)

    @cached_property
    def C(self) -> np.ndarray:
        """Rows c_j of the safe box |c_j x| <= 1, shape (k, n)."""
        return self.box

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
        return description.fingerprint_of(self)

    def has_fingerprint(self, fingerprint: str) -> bool:
        """Returns whether a fingerprint is this plant's, of today or of earlier versions that kept it elsewhere."""
        return description.has_fingerprint(self, fingerprint)

    def constraint_values(self, state: np.ndarray) -> np.ndarray:
        """Returns |c_j x| - 1 for each row of the safe box, shape (k,) or (k, N); positive is violated."""
        return abs(self.C.dot(state)) - 1.0
