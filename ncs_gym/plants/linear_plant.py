"""The linear plant and the hard bounds on everything uncertain about it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ncs_gym.uncertainty.ellipsoid import Ellipsoid, outer_sum
from ncs_gym.uncertainty.truncated_gaussian import SMALLEST_KEPT, TruncatedGaussian, chi2_quantile
from ncs_gym.validation import (
    FILLED_IN_LATER,
    LARGEST_NUMBER,
    SMALLEST_NUMBER,
    ReadOnlyArrays,
    as_covariance,
    as_matrix,
    as_names,
    as_number,
    as_setting,
    read_only,
    shown,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# Relative growth of every hard bound, so that rounding in sampling and quantizing stays inside (theory.md section 1).
INFLATION = 1.0 + 1e-9
# The same for directions in which a bound is flat: growth of its diagonal alone.
FLAT_INFLATION = 1e-12
# No disturbance set is thinner than this, in squared half-widths of the safe box.
THINNEST = 1e-19
# Simulating a step in float64 rounds; the disturbance bound has room for that up to this many half-widths out.
SIMULATED_REACH = 100.0
# An unstable plant that nobody holds runs away no further than this many half-widths: what lies beyond ends in NaN.
FARTHEST = 1e30
# Smaller truncation levels have no finite quantile in float64.
SMALLEST_DELTA = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearPlant(ReadOnlyArrays):
    """x+ = A x + B u + d, y = H x + v, with limits and bounds (theory.md section 1).

    Attributes:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        C: Rows c_j of the safe box |c_j x| <= 1, shape (k, n).
        u_max: Input limits |u_i| <= u_max_i, a positive number or shape (m,).
        dt: Duration of a step [s].
        gamma: Squared radius of the unknown disturbance, d'd <= gamma.
        H: Output matrix, shape (p, n); the identity by default.
        process_noise_cov: Q, shape (n, n), truncated at chi2_{n,1-delta}; zero by default.
        measurement_noise_cov: R, shape (p, p), truncated at chi2_{p,1-delta}; zero by default.
        initial_cov: P0 of the first estimate, shape (n, n), truncated alike; zero by default.
        delta: Probability mass that the truncation of each Gaussian removes, in [1e-12, 0.999].
        error_gain: The gain, shape (m, n), whose answers to an estimation error make it costly when error sets by age
            are chosen (docs/contracts.md), a certificate's K in round numbers; a regulator's by default.
        state_names, state_units, input_names, input_units: For tables and figures.

    Raises:
        ValueError: If a matrix has a wrong shape, is not finite or not a covariance, or a bound is
            negative.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    u_max: np.ndarray
    dt: float
    gamma: float
    H: np.ndarray = FILLED_IN_LATER
    process_noise_cov: np.ndarray = FILLED_IN_LATER
    measurement_noise_cov: np.ndarray = FILLED_IN_LATER
    initial_cov: np.ndarray = FILLED_IN_LATER
    delta: float = 0.05
    error_gain: np.ndarray | None = None
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
            C: ArrayLike,
            u_max: ArrayLike,
            dt: float,
            gamma: float,
            H: ArrayLike | None = None,
            process_noise_cov: ArrayLike | None = None,
            measurement_noise_cov: ArrayLike | None = None,
            initial_cov: ArrayLike | None = None,
            delta: float = 0.05,
            error_gain: ArrayLike | None = None,
            state_names: Sequence[str] = (),
            state_units: Sequence[str] = (),
            input_names: Sequence[str] = (),
            input_units: Sequence[str] = (),
        ) -> None: ...

    def __post_init__(self) -> None:
        A = as_matrix(self.A, (None, None), "A")
        n = A.shape[0]
        A = as_matrix(A, (n, n), "A")
        B = as_matrix(self.B, (n, None), "B")
        m = B.shape[1]
        H = np.eye(n) if self.H is None else as_matrix(self.H, (None, n), "H")
        self._set("A", A)
        self._set("B", B)
        self._set("C", as_matrix(self.C, (None, n), "C"))
        for name, matrix, does in (("C", self.C, "limit"), ("H", H, "measure")):
            if (np.abs(matrix).max(axis=1) < SMALLEST_NUMBER).any():
                raise ValueError(f"every row of {name} must {does} something, got {shown(matrix.tolist())}")
        self._set("H", H)
        self._set("u_max", _as_limits(self.u_max, m))
        self._set("dt", as_number(self.dt, "dt", low=0.0, low_open=True))
        self._set("gamma", as_number(self.gamma, "gamma", low=0.0))
        self._set("delta", as_number(self.delta, "delta", low=SMALLEST_DELTA, high=1.0 - SMALLEST_KEPT))
        for name, size in (("process_noise_cov", n), ("measurement_noise_cov", H.shape[0]), ("initial_cov", n)):
            value = getattr(self, name)
            self._set(name, np.zeros((size, size)) if value is None else as_covariance(value, size, name))
        if self.error_gain is not None:
            self._set("error_gain", as_matrix(self.error_gain, (m, n), "error_gain"))
        for name, size, letter in (("state", n, "x"), ("input", m, "u")):
            names = tuple(f"{letter}{i + 1}" for i in range(size))
            for field_name, default in ((f"{name}_names", names), (f"{name}_units", ("",) * size)):
                self._set(field_name, as_names(getattr(self, field_name), default, field_name))
        self._make_arrays_read_only()

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

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
    def spectral_radius(self) -> float:
        """Largest absolute eigenvalue of A; below 1 exactly when the plant is Schur stable."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

    @cached_property
    def weight(self) -> np.ndarray:
        """Positive definite W, shape (n, n), that measures ellipsoids in units of the safe box: C'C, regularized."""
        gram = self.C.T @ self.C
        return read_only(gram + 1e-6 * np.diag(np.diag(gram) + np.trace(gram) / self.n * (np.diag(gram) == 0.0)))

    @cached_property
    def relative_weight(self) -> np.ndarray:
        """W in units of its largest entry, shape (n, n): the identity exactly if the box is a cube."""
        return read_only(self.weight / self.weight.max())

    @cached_property
    def half_widths(self) -> np.ndarray:
        """Half-widths of the ellipsoid {x : x'Wx <= 1} around the safe box' center, shape (n,)."""
        return read_only(np.sqrt(np.diag(np.linalg.inv(self.weight))))

    @cached_property
    def state_limit(self) -> np.ndarray:
        """Where a simulation stops a state that runs away, shape (n,); infinite for a stable plant."""
        return read_only(FARTHEST * self.half_widths if self.spectral_radius >= 1.0 else np.full(self.n, np.inf))

    @cached_property
    def process_noise(self) -> TruncatedGaussian:
        """w ~ N(0, Q) truncated at chi2_{n,1-delta}."""
        return TruncatedGaussian(self.process_noise_cov, chi2_quantile(1.0 - self.delta, self.n))

    @cached_property
    def sensor_noise(self) -> TruncatedGaussian:
        """v ~ N(0, R) truncated at chi2_{p,1-delta}."""
        return TruncatedGaussian(self.measurement_noise_cov, chi2_quantile(1.0 - self.delta, self.p))

    @cached_property
    def initial_noise(self) -> TruncatedGaussian:
        """Error of the first estimate, e_0 ~ N(0, P0) truncated at chi2_{n,1-delta}."""
        return TruncatedGaussian(self.initial_cov, chi2_quantile(1.0 - self.delta, self.n))

    @cached_property
    def disturbance(self) -> Ellipsoid:
        """D, shape (n, n): holds d (with d'd <= gamma), the truncated process noise and the rounding of a simulation.

        It is larger than `allowed_disturbance` by what holds that plus E(F), F = n diag(r^2), with r the rounding of
        A x + B u + d for x up to SIMULATED_REACH half-widths out: (1+s/4) allowed + (1+4/s) F, s the inflation.
        """
        return Ellipsoid(_inflated(self.nominal_disturbance.shape) + self._rounding_room)

    @cached_property
    def allowed_disturbance(self) -> Ellipsoid:
        """What a disturbance may use of D: the rest is for the rounding of a simulation, shape (n, n)."""
        inflated = 0.5 * (self.nominal_disturbance.shape + _inflated(self.nominal_disturbance.shape))
        return Ellipsoid(inflated + 0.5 * self._rounding_room)

    @cached_property
    def _rounding_room(self) -> np.ndarray:
        """What D gains for rounding, shape (n, n)."""
        reach = SIMULATED_REACH * self.half_widths
        rounding = np.abs(self.A) @ reach + np.abs(self.B) @ self.u_max + reach
        rounding *= (self.n + self.m + 2) * np.finfo(float).eps
        box = np.linalg.inv(self.weight)
        return THINNEST * 0.5 * (box + box.T) + 10.0 * self.n / (INFLATION - 1.0) * np.diag(rounding**2)

    @cached_property
    def nominal_disturbance(self) -> Ellipsoid:
        """D before inflation: where extremal disturbances are drawn, so that their rounding stays inside E(D)."""
        ball = Ellipsoid(self.gamma * np.eye(self.n))
        return _sum_or_other(ball, self.process_noise.bound, self.relative_weight)

    @cached_property
    def sensor_error(self) -> Ellipsoid:
        """Holds the sensor noise v, shape (p, p), without the channel's quantizer (see `sensor_error_with`)."""
        return Ellipsoid(_inflated(self.sensor_noise.bound.shape))

    def sensor_error_with(self, quantization_step: float) -> Ellipsoid:
        """Returns N, shape (p, p): sensor noise plus the ball of squared radius p q^2/4 around a quantizer's box."""
        ball = Ellipsoid(self.p * quantization_step**2 / 4.0 * np.eye(self.p))
        return Ellipsoid(_inflated(_sum_or_other(ball, self.sensor_noise.bound, np.eye(self.p)).shape))

    @cached_property
    def initial_error(self) -> Ellipsoid:
        """r0^2 I and room for rounding, shape (n, n): holds the error of the first estimate.

        r0^2 = lambda_max(P0) chi2_{n,1-delta}.
        """
        r0_squared = float(np.linalg.eigvalsh(self.initial_noise.bound.shape)[-1])
        return Ellipsoid(INFLATION * max(r0_squared, 0.0) * np.eye(self.n) + self.estimate_rounding)

    @cached_property
    def estimate_rounding(self) -> np.ndarray:
        """Room for the rounding of x_hat up to SIMULATED_REACH half-widths out, shape (n, n), next to an inflation."""
        rounding = 4.0 * np.finfo(float).eps * SIMULATED_REACH * self.half_widths
        return read_only(2.0 * self.n / (INFLATION - 1.0) * np.diag(rounding**2))

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over every number of the plant, to bind certificates and models to it."""
        digest = hashlib.sha256()
        for name in ("A", "B", "C", "H", "u_max", "process_noise_cov", "measurement_noise_cov", "initial_cov"):
            array = getattr(self, name)
            digest.update(f"{name}{array.shape}".encode() + array.astype("<f8").tobytes())
        digest.update(np.array([self.dt, self.gamma, self.delta], dtype="<f8").tobytes())
        if self.error_gain is not None:
            digest.update(self.error_gain.astype("<f8").tobytes())
        return digest.hexdigest()

    def constraint_values(self, state: np.ndarray) -> np.ndarray:
        """Returns |c_j x| - 1 for each row of the safe box, shape (k,) or (k, N); positive is violated."""
        return abs(self.C.dot(state)) - 1.0


def _as_limits(value: Any, size: int) -> np.ndarray:
    """Returns input limits as a positive finite array of shape (size,)."""
    limits = as_setting(value)
    if (
        limits is None
        or limits.shape not in ((), (size,))
        or not ((limits >= SMALLEST_NUMBER) & (limits < LARGEST_NUMBER)).all()
    ):
        raise ValueError(f"u_max must be a positive number or shape ({size},), got {shown(value)}")
    return np.broadcast_to(limits, (size,)).copy()


def _inflated(shape: np.ndarray) -> np.ndarray:
    """Returns a bound with room for the rounding of sampling it."""
    return INFLATION * shape + FLAT_INFLATION * np.diag(np.diag(shape))


def _sum_or_other(first: Ellipsoid, second: Ellipsoid, weight: np.ndarray) -> Ellipsoid:
    """Returns an ellipsoid around the sum, of the smallest tr(W P); where one of them is a point, the other alone."""
    if not np.any(first.shape):
        return second
    if not np.any(second.shape):
        return first
    return Ellipsoid(outer_sum(first.shape, second.shape, weight))
