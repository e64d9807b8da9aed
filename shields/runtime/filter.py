"""The shield's decision: a pure function of estimate, error ellipsoid and proposed input."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.validation import ReadOnlyArrays, as_numbers, shown
from shields.certificate import Certificate
from shields.errors import CertificateError
from shields.runtime.one_step_test import MOST_INPUTS_WITH_VERTICES, OneStepTest, ReachableSets
from shields.runtime.predicted_errors import SMALLEST_RADIUS, PredictedErrors, predicted_errors
from shields.runtime.projection import closest_on_lines
from shields.verification import ACTION_ROUNDING, require_valid

MODES = ("project", "switch", "boundary", "monitor")
REASONS = ("safe", "projected", "fallback", "unsafe", "invalid")
SAFE, PROJECTED, FALLBACK, UNSAFE, INVALID = range(5)
# The test must be passed by this much, in units of the safe set: far more than the rounding of its computation.
MARGIN = 1e-9
# Single error shapes that are remembered; they recur, since they depend only on what arrived when.
MOST_REMEMBERED = 4096
FLOAT64 = np.dtype(np.float64)


class Decision(NamedTuple):
    """What the shield decided; of many decisions, arrays whose last axis is the environment.

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
            Of many decisions, indices of `REASONS`.
    """

    input: np.ndarray
    intervened: Any
    passed: Any
    fallback: Any
    margin: Any
    reason: Any


@dataclass(frozen=True, eq=False)
class SafetyFilter(ReadOnlyArrays):
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
    _remembered: dict[bytes, PredictedErrors] = field(init=False, repr=False)

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
        object.__setattr__(self, "_remembered", {})

    @cached_property
    def _limits(self) -> list[float]:
        return self.plant.u_max.tolist()

    @cached_property
    def reserve(self) -> float:
        """The slack a projected input needs: the margin, and what rounding the action to float32 can move x+."""
        effect = float(np.linalg.norm(self.test.effect, axis=0) @ self.plant.u_max)
        return 2.0 * MARGIN + float(ACTION_ROUNDING) * effect

    def decide(self, estimate: np.ndarray, error_shape: np.ndarray, input_proposed: np.ndarray) -> Decision:
        """Returns the input to apply; never raises.

        Args:
            estimate: x_hat, shape (n,), float64.
            error_shape: Sigma_k, shape (n, n): x_hat - x lies in E(Sigma_k).
            input_proposed: Shape (m,) [physical units]; the very float64 value that would be applied.
        """
        return self.decide_knowing(_as_array(estimate), self.errors_of(error_shape), _as_array(input_proposed))

    def decide_knowing(self, estimate: np.ndarray, errors: PredictedErrors, proposed: np.ndarray) -> Decision:
        """Returns what `decide` does, given `errors_of` the error shape."""
        n, m = self.plant.n, self.plant.m
        if estimate.shape == (n,) and proposed.shape == (m,) and self.mode != "boundary":
            try:
                decision = self._decide_single(estimate, errors, proposed)
            except FloatingPointError:  # underflow, where numpy is told to raise
                decision = None
            if decision is not None:
                return decision
        decided = self.decide_many(_as_column(estimate, n), errors.batch(), _as_column(proposed, m))
        u, *flags = (array[..., 0].tolist() for array in decided)
        intervened, passed, fallback, margin, reason = flags
        return Decision(np.array(u), intervened, passed, fallback, margin, REASONS[reason])

    def _decide_single(self, estimate: np.ndarray, errors: PredictedErrors, proposed: np.ndarray) -> Decision | None:
        """Returns the decision in the common cases: an input that passes, and a single input that is projected.

        By the formulas of `ReachableSets`, without an axis of environments: five times faster than a batch of one.
        """
        test = self.test
        radius = errors.radius - test.rounding * float(test.columns.dot(np.abs(estimate)))
        if not (radius >= SMALLEST_RADIUS and self._is_within_limits(proposed.tolist())):
            return None
        offset = test.moved.dot(estimate)
        margin = self._margin_if_passed(errors.turn, radius, offset, proposed)
        if margin is not None:
            return Decision(proposed.copy(), False, True, False, margin, REASONS[SAFE])
        if self.mode != "project" or self.plant.m > 1:
            return None
        closest = self._closest_single(errors.turn, radius, offset, proposed)
        margin = self._margin_if_passed(errors.turn, radius, offset, closest)
        return None if margin is None else Decision(closest, True, True, False, margin, REASONS[PROJECTED])

    def _margin_if_passed(self, turn: np.ndarray, radius: float, offset: np.ndarray, u: np.ndarray) -> float | None:
        """Returns the margin of an input, shape (m,), that passes the test; None if it does not."""
        center = offset + self.test.effect.dot(u)
        turned = turn.dot(center)
        if radius - float(turned.dot(turned)) ** 0.5 >= MARGIN:
            return radius - float(center.dot(center)) ** 0.5
        return None

    @np.errstate(all="ignore")
    def _closest_single(self, turn: np.ndarray, radius: float, offset: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns the closest input that passes, shape (1,), of plants with one; NaN if there is none."""
        effect, offset = turn.dot(self.test.effect[:, 0]), turn.dot(offset)
        form = effect.dot(effect), effect.dot(offset), offset.dot(offset)
        return self._expressible(closest_on_lines(u, *form, radius - self.reserve, self.plant.u_max))

    @np.errstate(all="ignore")  # what is not finite passes no test
    def decide_many(self, estimates: np.ndarray, errors: PredictedErrors, proposed: np.ndarray) -> Decision:
        """Returns the inputs to apply in N environments, and what `Decision` says about them, as new arrays.

        Args:
            estimates: x_hat, shape (n, N).
            errors: What is known of the Sigma_k of each.
            proposed: Shape (m, N) [physical units].
        """
        sets = self.test.reachable(estimates, errors)
        slack, margin = sets.slack(proposed)
        judged = sets.smallest_slack() if self.mode == "boundary" else slack
        valid = (np.abs(proposed) <= self.plant.u_max[:, None]).all(axis=0)
        passed = (judged >= MARGIN) & valid
        fallback, reason = np.zeros(len(passed), np.bool_), np.zeros(len(passed), np.int64)
        decided = Decision(proposed.copy(), ~passed, passed, fallback, margin, reason)
        if self.mode == "project":
            self._project(decided, np.flatnonzero(~passed & valid), sets)
        self._fall_back(decided, np.flatnonzero(~decided.passed), sets, estimates, valid)
        return decided

    def errors_of(self, error_shape: Any) -> PredictedErrors:
        """Returns what is known of one error shape, (n, n), without a last axis; remembered, since shapes recur."""
        shape = _as_array(error_shape)
        key = shape.tobytes() if shape.shape == (self.plant.n, self.plant.n) else b""
        known = self._remembered.get(key)
        if known is None:
            usable = shape if key else np.full((self.plant.n, self.plant.n), np.nan)
            known = self.errors_of_many(usable[None]).single()
            if len(self._remembered) >= MOST_REMEMBERED:
                self._remembered.clear()
            self._remembered[key] = known
        return known

    def errors_of_many(self, error_shapes: np.ndarray) -> PredictedErrors:
        """Returns what is known of error shapes, (k, n, n)."""
        return predicted_errors(self.test, error_shapes, self.certificate.error_shapes)

    def margin(self, estimate: np.ndarray, error_shape: np.ndarray, u: np.ndarray) -> float:
        """Returns 1 - h - |A x_hat + B u|_M for an input u, shape (m,); NaN if any of them is unusable."""
        x_hat, errors = _as_column(_as_array(estimate), self.plant.n), self.errors_of(error_shape).batch()
        return float(self.margins(x_hat, errors, _as_column(_as_array(u), self.plant.m))[0])

    @np.errstate(all="ignore")
    def margins(self, estimates: np.ndarray, errors: PredictedErrors, inputs: np.ndarray) -> np.ndarray:
        """Returns what `margin` does in N environments, shape (N,); the arguments are those of `decide_many`."""
        return self.test.reachable(estimates, errors).slack(inputs)[1]

    @np.errstate(all="ignore")
    def knows_inside(self, estimate: np.ndarray, error_shape: np.ndarray) -> bool:
        """Returns whether |x_hat|_M + sqrt(lambda_max(M Sigma_k)) <= 1, which proves that x is in S."""
        x_hat, errors = _as_array(estimate), self.errors_of(error_shape)
        return x_hat.shape == (self.plant.n,) and bool(self.test.knows_inside(x_hat, errors, MARGIN))

    def fallback_input(self, estimate: np.ndarray) -> np.ndarray:
        """Returns K x_hat, shape (m,), clipped to the limits and rounded to what a float32 action can express.

        Raises:
            ValueError: If the estimate is not finite or does not have shape (n,), or K x_hat overflows.
        """
        gained = self._gained(_as_column(_as_array(estimate), self.plant.n))[:, 0]
        if not np.isfinite(gained).all():
            raise ValueError(f"the estimate must be finite with shape ({self.plant.n},), got {shown(estimate)}")
        return gained

    def _project(self, decided: Decision, some: np.ndarray, sets: ReachableSets) -> None:
        """Puts the closest input that passes, where there is one, in the place of some of those decided."""
        if some.size:
            sets = sets.some(some)
            closest = self._expressible(sets.closest(decided.input[:, some], self.reserve))
            slack, margin = sets.slack(closest)
            found = slack >= MARGIN
            some = some[found]
            decided.input[:, some], decided.margin[some] = closest[:, found], margin[found]
            decided.passed[some], decided.reason[some] = True, PROJECTED

    def _fall_back(
        self, decided: Decision, some: np.ndarray, sets: ReachableSets, estimates: np.ndarray, valid: np.ndarray
    ) -> None:
        """Puts K x_hat in the place of some inputs, zero if there is none; in "monitor" only where one is no input."""
        if some.size:
            proposed, gained, sets = decided.input[:, some], self._gained(estimates[:, some]), sets.some(some)
            exists = np.isfinite(gained).all(axis=0)
            gained = np.where(exists, gained, 0.0)
            differs, valid = (gained != proposed).any(axis=0), valid[some]
            applied = np.where(valid, proposed, gained) if self.mode == "monitor" else gained
            slack, margin = sets.slack(applied)
            decided.input[:, some], decided.margin[some] = applied, margin
            decided.intervened[some], decided.passed[some] = differs, slack >= MARGIN
            unsafe = (applied != gained).any(axis=0)
            decided.fallback[some] = exists & ~unsafe
            reason = np.where(unsafe, UNSAFE, FALLBACK)
            decided.reason[some] = np.where(valid & ~np.isnan(sets.radius), reason, INVALID)

    @np.errstate(all="ignore")
    def _gained(self, estimates: np.ndarray) -> np.ndarray:
        """Returns K x_hat as actions can express it, shape (m, N); NaN where it cannot be computed."""
        gained = self.certificate.K @ estimates
        return np.where(np.isfinite(gained).all(axis=0), self._expressible(gained), np.nan)

    def _is_within_limits(self, u: list[float]) -> bool:
        """Returns whether every one of m numbers lies within its limit, which no NaN does."""
        return all(-limit <= value <= limit for value, limit in zip(u, self._limits, strict=True))

    def _expressible(self, inputs: np.ndarray) -> np.ndarray:
        """Returns the nearest u_max * float32 actions, shape (m, N) or (m,)."""
        limits = self.plant.u_max if inputs.ndim == 1 else self.plant.u_max[:, None]
        actions = np.minimum(np.maximum(inputs / limits, -1.0), 1.0)
        return limits * actions.astype(np.float32)


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


def _as_column(array: np.ndarray, size: int) -> np.ndarray:
    """Returns a batch of one, shape (size, 1); NaN for an array of another shape."""
    return array[:, None] if array.shape == (size,) else np.full((size, 1), np.nan)
