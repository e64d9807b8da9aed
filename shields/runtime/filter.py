"""The shield's decision: a pure function of estimate, error ellipsoid and proposed input."""

from __future__ import annotations

from ctypes import c_float
from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite
from operator import mul
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.validation import FrozenArrays, as_numbers, shown
from shields.certificate import Certificate, CertificateError
from shields.runtime.one_step_test import MOST_INPUTS_WITH_VERTICES, OneStepTest, Outlook
from shields.runtime.plane import PlaneOutlook
from shields.verification import ACTION_ROUNDING, require_valid

MODES = ("project", "switch", "boundary", "monitor")
# The test must be passed by this much, in units of the safe set: far more than the rounding of its computation.
MARGIN = 1e-9
FLOAT64 = np.dtype(np.float64)


class Decision(NamedTuple):
    """What the shield decided.

    Attributes:
        input: Input to apply, shape (m,), within the limits; u_max times a float32 action if not the proposed one.
        intervened: Whether it differs from the proposed one; in mode "monitor": whether that of "switch" would.
        passed: Whether it meets the one-step test, so that x+ is in S even if x is not.
        fallback: Whether it is K x_hat, so that x+ is in S if x is and Sigma_k lies inside the certificate's Sigma.
        margin: 1 - h - |A x_hat + B u|_M at the input to apply. Positive only if the test is met; the test is sharper
            and admits some inputs for which this is slightly negative. NaN without a usable estimate.
        reason: "safe" (passed as proposed), "projected", "fallback" (u = K x_hat), "unsafe" (applied as proposed by
            "monitor"), or "invalid" (what was proposed is no input within the limits, or estimate or error shape is
            unusable: u = K x_hat, zero without a usable estimate, in "monitor" what was proposed if it is an input).
    """

    input: np.ndarray
    intervened: bool
    passed: bool
    fallback: bool
    margin: float
    reason: str


@dataclass(frozen=True, eq=False)
class SafetyFilter(FrozenArrays):
    """A certificate made ready to judge inputs (docs/shield.md).

    An input passes if everything that one step can reach with it, for every error in E(Sigma_k) and disturbance in
    E(D), lies in S (`OneStepTest`). K x_hat needs no test: its safety follows from x in S by (I) and (U).

    Args:
        certificate: Verified exactly here; what does not verify is refused.
        plant: The plant it was made for.
        mode: What becomes of an input that does not pass: "project" applies the closest one that does (Euclidean
            distance in physical units, to within float32), "switch" (and "project" if there is none) K x_hat.
            "boundary" applies K x_hat unless *every* input within the limits passes. "monitor" applies what is
            proposed and says whether "switch" would have; it protects nothing.

    Attributes:
        test: The one-step test.

    Raises:
        CertificateError: If the certificate does not verify for the plant, or float64 is too coarse for it.
        ValueError: If the mode is unknown, or "boundary" for more than twelve inputs.
    """

    certificate: Certificate
    plant: LinearPlant
    mode: str = "project"
    test: OneStepTest = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not (isinstance(self.mode, str) and self.mode in MODES):
            raise ValueError(f"mode must be one of {list(MODES)}, got {shown(self.mode)}")
        if not isinstance(self.certificate, Certificate) or not isinstance(self.plant, LinearPlant):
            kinds = f"{type(self.certificate).__name__} and {type(self.plant).__name__}"
            raise ValueError(f"SafetyFilter takes a Certificate and a LinearPlant, got {kinds}")
        if self.mode == "boundary" and self.plant.m > MOST_INPUTS_WITH_VERTICES:
            raise ValueError(
                f'mode "boundary" looks at 2^m vertices and takes at most {MOST_INPUTS_WITH_VERTICES} inputs, '
                f"got {self.plant.m}"
            )
        require_valid(self.certificate, self.plant)
        require_computable(self.certificate, self.plant)
        object.__setattr__(self, "test", OneStepTest(self.certificate.L, self.plant))

    @cached_property
    def _limits(self) -> list[float]:
        return self.plant.u_max.tolist()

    @cached_property
    def _gain(self) -> list[list[float]]:
        return self.certificate.K.tolist()

    @cached_property
    def reserve(self) -> float:
        """The room a projected input needs: the margin, and what rounding the action to float32 can move x+."""
        effect = float(np.linalg.norm(self.test.effect, axis=0) @ self.plant.u_max)
        return 2.0 * MARGIN + float(ACTION_ROUNDING) * effect

    def decide(self, estimate: np.ndarray, error_shape: np.ndarray, input_proposed: np.ndarray) -> Decision:
        """Returns the input to apply; never raises.

        Args:
            estimate: x_hat, shape (n,), float64.
            error_shape: Sigma_k, shape (n, n): x_hat - x lies in E(Sigma_k).
            input_proposed: Shape (m,) [physical units]; the very float64 value that would be applied.
        """
        estimate, error_shape = _as_array(estimate), _as_array(error_shape)
        proposed = _as_array(input_proposed)
        u = proposed.tolist()
        if proposed.shape != (self.plant.m,) or not self._is_within_limits(u):
            u = None
        outlook = self.test.at(estimate, error_shape)
        if outlook is None or u is None:
            return self._fallback(estimate, outlook, u)
        room, margin = outlook.judge(u)
        if (outlook.smallest_room() if self.mode == "boundary" else room) >= MARGIN:
            return Decision(proposed.copy(), False, True, False, margin, "safe")
        if self.mode == "project":
            closest = outlook.closest(u, self.reserve)
            if closest is not None:
                closest = self._expressible(closest)
                room, margin = outlook.judge(closest)
                if room >= MARGIN:
                    return Decision(np.array(closest), True, True, False, margin, "projected")
        return self._fallback(estimate, outlook, u)

    def margin(self, estimate: np.ndarray, error_shape: np.ndarray, u: np.ndarray) -> float:
        """Returns 1 - h - |A x_hat + B u|_M for an input u, shape (m,); NaN if any of them is unusable."""
        outlook, u = self.test.at(_as_array(estimate), _as_array(error_shape)), _as_array(u)
        return float("nan") if outlook is None or u.shape != (self.plant.m,) else outlook.judge(u.tolist())[1]

    def knows_inside(self, estimate: np.ndarray, error_shape: np.ndarray) -> bool:
        """Returns whether |x_hat|_M + sqrt(lambda_max(M Sigma_k)) <= 1, which proves that x is in S."""
        return self.test.knows_inside(_as_array(estimate), _as_array(error_shape), MARGIN)

    def fallback_input(self, estimate: np.ndarray) -> np.ndarray:
        """Returns K x_hat, shape (m,), clipped to the limits and rounded to what a float32 action can express.

        Raises:
            ValueError: If the estimate is not finite or does not have shape (n,), or K x_hat overflows.
        """
        u = self._gained(_as_array(estimate))
        if u is None:
            raise ValueError(f"the estimate must be finite with shape ({self.plant.n},), got {shown(estimate)}")
        return np.array(u)

    def _fallback(
        self, estimate: np.ndarray, outlook: Outlook | PlaneOutlook | None, proposed: list[float] | None
    ) -> Decision:
        """Returns K x_hat, zero if there is none; in "monitor" what was proposed, unless that is no input (None)."""
        gained = self._gained(estimate)
        u = [0.0] * self.plant.m if gained is None else gained
        differs = u != proposed
        kept = proposed if self.mode == "monitor" else None
        unsafe = kept is not None and differs
        reason = "invalid" if outlook is None or proposed is None else "unsafe" if unsafe else "fallback"
        applied = u if kept is None else kept
        room, margin = (float("nan"),) * 2 if outlook is None else outlook.judge(applied)
        fallback = gained is not None and applied == gained
        return Decision(np.array(applied), differs, room >= MARGIN, fallback, margin, reason)

    def _gained(self, estimate: np.ndarray) -> list[float] | None:
        """Returns K x_hat as an action can express it, m numbers; None if it cannot be computed."""
        x_hat = estimate.tolist()
        if estimate.shape != (self.plant.n,):
            return None
        u: list[float] = [sum(map(mul, row, x_hat)) for row in self._gain]
        return self._expressible(u) if isfinite(sum(u)) else None

    def _expressible(self, u: list[float]) -> list[float]:
        """Returns the nearest u_max * float32 action, m numbers."""
        rounded = []
        for value, limit in zip(u, self._limits):  # noqa: B905
            action = value / limit
            action = 1.0 if action > 1.0 else -1.0 if action < -1.0 else c_float(action).value
            rounded.append(limit * action)
        return rounded

    def _is_within_limits(self, u: list[float]) -> bool:
        """Returns whether every entry lies within its limit, which no NaN does (as a loop: half the time of `all`)."""
        for value, limit in zip(u, self._limits):  # noqa: B905, SIM110
            if not -limit <= value <= limit:
                return False
        return True


def require_computable(certificate: Certificate, plant: LinearPlant) -> None:
    """Raises unless float64 computes K x_hat on S more accurately than (I) and (U) make room for.

    D_u allows a shift by 2^-24 u_max, twice what rounding an action to float32 does; the other half is for this.

    Raises:
        CertificateError: If it does not.
    """
    extent = np.sqrt(np.diag(certificate.L))
    if len(certificate.error_shapes):
        extent = extent + np.sqrt(np.diagonal(certificate.error_shapes, axis1=1, axis2=2)).max(axis=0)
    error = (plant.n + 2) * np.finfo(float).eps * (np.abs(certificate.K) @ extent)
    if (error > 0.25 * float(ACTION_ROUNDING) * plant.u_max).any():
        raise CertificateError("the gain is too large against the input limits to compute K x_hat in float64")


def _as_array(value: Any) -> np.ndarray:
    """Returns float64 numbers; an empty array, which has no usable shape, for what are none."""
    if type(value) is np.ndarray and value.dtype is FLOAT64:  # the common case, without another call
        return value
    array = as_numbers(value)
    return np.empty(0) if array is None else array
