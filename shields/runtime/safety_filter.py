"""The shield's decision: a pure function of estimate, error ellipsoid and proposed input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from math import isnan
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.envs.spaces import expressible
from ncs_gym.validation import ReadOnlyArrays, as_count, as_numbers, read_only, shown
from shields.certificate import Certificate
from shields.runtime.set_test import (
    MOST_INPUTS_WITH_VERTICES,
    PredictedErrors,
    ReachableSets,
    SetTest,
    certificate_test,
    require_computable,
)
from shields.verification import ACTION_ROUNDING, require_valid

REASONS = ("safe", "projected", "fallback", "unsafe", "invalid", "planned", "stored")
SAFE, PROJECTED, FALLBACK, UNSAFE, INVALID, PLANNED, STORED = range(7)
NO_PLAN = read_only(np.empty((0, 0)))
Mode = Literal["project", "lookahead", "switch", "boundary", "monitor"]
MODES = get_args(Mode)
# Longest plan of mode "lookahead", in steps, where none is given, and the longest there is.
DEFAULT_HORIZON, LONGEST_HORIZON = 6, 50
# The test must be passed by this much, in units of the safe set: far more than the rounding of its computation.
MARGIN = 1e-9
# Single error shapes that are remembered; they recur, since they depend only on what arrived when.
MOST_REMEMBERED = 4096
FLOAT64 = np.dtype(np.float64)


class Decision(NamedTuple):
    """What the shield decided; of many decisions, arrays whose last axis is the environment.

    S is the certificate's safe set, a polytope or an ellipsoid.

    Attributes:
        input: Input to apply, shape (m,), within the limits; that of a float32 action if not the proposed one.
        intervened: Whether it differs from the proposed one, so that `~intervened` is a mask of proposals that may act;
            in mode "monitor": whether that of "switch" would differ.
        proved: Whether the input to apply, not the proposed one, meets the one-step test, so that x+ is in S even if x
            is not, or begins a certified plan, so that x+ is in the box and what is left of the plan keeps it there.
        fallback: Whether it is K x_hat, so that x+ is in S if x is and Sigma_k lies inside the certificate's Sigma.
        margin: 1 - h - |A x_hat + B u|_M at the input to apply, where h is the farthest that error and disturbance
            move x+, measured by |.|_M. Positive only if the test is met; the test is sharper and admits some inputs
            for which this is slightly negative. With a polytope it is the least that is left of a row. NaN without a
            usable estimate.
        reason: "safe" (passed as proposed), "projected", "fallback" (u = K x_hat), "unsafe" (applied as proposed by
            "monitor"), or "invalid" (what was proposed is no input within the limits, or estimate or error shape is
            unusable: u = K x_hat, zero without a usable estimate, in "monitor" what was proposed if it is an input).
            In mode "lookahead" also "planned" (a new plan begins, perhaps with the input proposed) and "stored" (the
            next input of the stored plan, also in the place of "invalid"). Of many decisions, indices of `REASONS`.
        plan: Inputs still stored after this decision, shape (k, m), to be handed to the next one; of many decisions
            shape (horizon, m, N), NaN beyond a plan's end. Empty in other modes than "lookahead".
        stored: Whether the input is the next one of the stored plan.
    """

    input: np.ndarray
    intervened: Any
    proved: Any
    fallback: Any
    margin: Any
    reason: Any
    plan: np.ndarray = NO_PLAN
    stored: Any = False


@dataclass(frozen=True, eq=False)
class SafetyFilter(ReadOnlyArrays):
    """A certificate made ready to judge inputs (docs/shield.md).

    An input passes if everything that one step can reach with it, for every error in E(Sigma_k) and disturbance in
    E(D), lies in S (`SetTest`). K x_hat needs no test: its safety
    follows from x in S by (I) and (U) of docs/shield_proof.md, or from x in the polytope by (P) and (PU).

    Args:
        certificate: Verified exactly here.
        plant: The plant it was made for.
        mode: What becomes of an input that does not pass: "project" applies the closest one that does (Euclidean
            distance in physical units, to within float32), "switch" (and "project" if there is none) K x_hat.
            "boundary" applies K x_hat unless *every* input within the limits passes. "monitor" applies what is
            proposed and says whether "switch" would have; it protects nothing. "lookahead" lets an input pass after
            which a certified plan keeps the state in the box until it is in S, and stores that plan
            (docs/lookahead.md).
        horizon: Longest plan of mode "lookahead", 1 to 50 steps; None is 6. Other modes take none.

    Attributes:
        test: The test of an input.
        lookahead: What finds and certifies the plans of mode "lookahead"; None in others.

    Raises:
        CertificateError: If the certificate does not verify for the plant, or float64 is too coarse for it.
        ValueError: If the mode is unknown, or "boundary" for more than twelve inputs, or the horizon is wrong.
    """

    certificate: Certificate
    plant: LinearPlant
    mode: str = "project"
    horizon: int | None = None
    test: SetTest = field(init=False, repr=False)
    lookahead: Any = field(init=False, repr=False)
    planner: ClassVar[Callable[..., Any]]  # of mode "lookahead": set where the package is put together
    _no_plan: np.ndarray = field(init=False, repr=False)
    _constant: np.ndarray = field(init=False, repr=False)
    _low: np.ndarray = field(init=False, repr=False)
    _high: np.ndarray = field(init=False, repr=False)
    _remembered: dict[bytes, PredictedErrors] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        horizon = plan_horizon(self.mode, self.horizon)
        if not isinstance(self.certificate, Certificate) or not isinstance(self.plant, LinearPlant):
            kinds = f"{type(self.certificate).__name__} and {type(self.plant).__name__}"
            raise ValueError(
                f"a shield takes a Certificate (Certificate.load reads one) and a LinearPlant, got {kinds}"
            )
        if self.mode == "boundary" and self.plant.m > MOST_INPUTS_WITH_VERTICES:
            raise ValueError(f'mode "boundary" takes at most {MOST_INPUTS_WITH_VERTICES} inputs, got {self.plant.m}')
        require_valid(self.certificate, self.plant)
        require_computable(self.certificate, self.plant)
        object.__setattr__(self, "test", certificate_test(self.certificate, self.plant))
        object.__setattr__(self, "_no_plan", read_only(np.empty((0, self.plant.m))))
        fallback = self.certificate.fallback
        columns = {"_constant": fallback.constant, "_low": self.plant.input_ends[0], "_high": self.plant.input_ends[1]}
        for name, each in columns.items():
            object.__setattr__(self, name, read_only(each[:, None]))
        object.__setattr__(self, "_remembered", {})
        object.__setattr__(self, "horizon", horizon)
        object.__setattr__(self, "lookahead", None)
        if horizon is not None:
            object.__setattr__(self, "lookahead", self.planner(self.test, fallback, horizon, MARGIN))

    @cached_property
    def _single(self) -> tuple[tuple[int], tuple[int]]:
        """Shapes of a single estimate and input."""
        return (self.plant.n,), (self.plant.m,)

    @cached_property
    def projection_margin(self) -> float:
        """The test margin a projected input needs: MARGIN, and what rounding the action to float32 can move x+."""
        return 2.0 * MARGIN + float(ACTION_ROUNDING) * self.test.shift

    @np.errstate(all="ignore")
    def decide(
        self,
        estimate: np.ndarray,
        error_shape: np.ndarray | PredictedErrors,
        input_proposed: np.ndarray,
        stored: Any = (),
    ) -> Decision:
        """Returns the input to apply; never raises.

        Args:
            estimate: x_hat, shape (n,), or a number if n = 1, float64.
            error_shape: Sigma_k, shape (n, n): x_hat - x lies in E(Sigma_k). Or what `errors_of` says of it.
            input_proposed: Shape (m,), or a number if m = 1 [physical units]; the very float64 value that would be
                applied.
            stored: In mode "lookahead" the `plan` of the last decision, shape (k, m), if its input was applied and one
                step has passed since. What is no plan of at most `horizon` inputs within the limits counts as none.
        """
        # Read once; numbers are vectors of one entry.
        x_hat, proposed = (np.atleast_1d(_as_array(each)).copy() for each in (estimate, input_proposed))
        errors = self.errors_of(error_shape)
        alone = (x_hat.shape, proposed.shape) == self._single
        if alone and (decision := self.decide_alone(x_hat, errors, proposed, stored)) is not None:
            return decision
        n, m = self.plant.n, self.plant.m
        plans = self._no_plan if self.lookahead is None else self.lookahead.as_stored(stored)
        decided = self.decide_columns(_as_column(x_hat, n), errors.batch(), _as_column(proposed, m), plans[..., None])
        one = Decision(*(array[..., 0].tolist() for array in decided))
        plan = decided.plan[..., 0]
        plan = plan[~np.isnan(plan[:, 0])] if len(plan) else self._no_plan
        return one._replace(input=np.array(one.input), reason=REASONS[one.reason], plan=plan)

    def decide_alone(
        self, estimate: np.ndarray, errors: PredictedErrors, proposed: np.ndarray, stored: Any
    ) -> Decision | None:
        """Returns the decision in the common cases, in half the time: what passes, begins a plan, or is projected.

        Estimate, shape (n,), and proposal, (m,), are float64 arrays that nobody writes to; None in other cases.
        """
        if self.mode == "boundary":
            return None
        lookahead = self.lookahead
        for u, (low, high) in zip(proposed.tolist(), self.test.limits, strict=True):
            if not low <= u <= high:  # neither NaN
                return None
        test_margin, margin = self.test.margins_alone(estimate, errors, proposed)
        if test_margin >= MARGIN:
            return Decision(proposed, False, True, False, margin, REASONS[SAFE], self._no_plan)
        if isnan(test_margin):
            return None
        plan = None if lookahead is None else lookahead.beginning_alone(estimate, errors, proposed)
        if plan is not None:
            return Decision(plan[0], False, True, False, margin, REASONS[PLANNED], plan[1:])
        if self.mode not in ("project", "lookahead") or self.plant.m > 1:
            return None
        closest = self.test.closest_alone(estimate, errors, proposed.item(), self.projection_margin)
        closest = self._expressible(np.array([closest]))
        test_margin, margin = self.test.margins_alone(estimate, errors, closest)
        if not test_margin >= MARGIN:  # also for NaN
            return None
        if lookahead is not None and lookahead.may_do_better(estimate, errors, proposed, closest, stored):
            return None
        return Decision(closest, True, True, False, margin, REASONS[PROJECTED], self._no_plan)

    def decide_columns(
        self, estimates: np.ndarray, errors: PredictedErrors, proposed: np.ndarray, stored: np.ndarray | None = None
    ) -> Decision:
        """Returns the inputs to apply in N environments, and what `Decision` says about them, as new arrays.

        Args:
            estimates: x_hat, shape (n, N).
            errors: What is known of the Sigma_k of each.
            proposed: Shape (m, N) [physical units].
            stored: In mode "lookahead" the `plan` of the last decisions, shape (horizon, m, N); None for none.
        """
        sets = self.test.reachable(estimates, errors)
        test_margin, margin = sets.margins(proposed)
        judged = sets.smallest_test_margin() if self.mode == "boundary" else test_margin
        within: np.ndarray = (self._low <= proposed) & (proposed <= self._high)
        valid: np.ndarray = within[0] if len(within) == 1 else np.all(within, axis=0)
        passed = (judged >= MARGIN) & valid
        fallback, reason = np.zeros(len(passed), np.bool_), np.zeros(len(passed), np.int64)
        plan = np.full((self.horizon or 0, *proposed.shape), np.nan)
        stored = plan.copy() if stored is None else stored
        decided = Decision(proposed.copy(), ~passed, passed, fallback, margin, reason, plan, np.zeros_like(fallback))
        if self.lookahead is not None:
            self.lookahead.keep(decided, valid, estimates, errors, stored)
        if self.mode in ("project", "lookahead"):
            self._project(decided, np.flatnonzero(~decided.proved & valid), sets)
        self._fall_back(decided, np.flatnonzero(~decided.proved), sets, estimates, valid)
        if self.lookahead is not None:
            self.lookahead.complete(decided, sets, estimates, errors, proposed, stored)
        return decided

    @np.errstate(all="ignore")
    def decide_many(
        self, estimates: Any, error_shapes: Any, proposals: Any, stored: np.ndarray | None = None
    ) -> Decision:
        """Returns what `decide` does for N control loops at once; the loop is the first axis of all arrays.

        Args:
            estimates: x_hat, shape (N, n).
            error_shapes: Sigma_k, shape (N, n, n), or (n, n) for all.
            proposals: Inputs, shape (N, m) [physical units].
            stored: In mode "lookahead" the `plan` of the last decisions, shape (N, horizon, m); None for none. What is
                no plan counts as none.

        Returns:
            A `Decision` of arrays: `input` of shape (N, m), `plan` (N, horizon, m), `reason` of texts, and truth values
            and margins of shape (N,). Rows that are not finite are "invalid".

        Raises:
            ValueError: If an argument does not consist of numbers of these shapes.
        """
        (n,), (m,) = self._single
        numbers = {"estimates": estimates, "error_shapes": error_shapes, "proposals": proposals}
        arrays = {name: _as_array(value) for name, value in numbers.items()}
        count = len(arrays["estimates"]) if arrays["estimates"].ndim == 2 else 0
        shapes = {"estimates": [(count, n)], "error_shapes": [(n, n), (count, n, n)], "proposals": [(count, m)]}
        if stored is not None:
            arrays["stored"], shapes["stored"] = _as_array(stored), [(count, self.horizon or 0, m)]
        for name, array in arrays.items():
            if array.shape not in shapes[name]:
                wanted = " or ".join(str(shape).replace(f"({count},", "(N,", 1) for shape in shapes[name])
                raise ValueError(f"{name} must be numbers of shape {wanted}, got {array.shape}; N = {count}")
        one_shape = arrays["error_shapes"].ndim == 2
        errors = self.errors_of_many(arrays["error_shapes"][None] if one_shape else arrays["error_shapes"])
        errors = errors.of(np.zeros(count, np.intp)) if one_shape else errors
        columns = [np.array(arrays[name].T, order="C") for name in ("estimates", "proposals")]
        plans = None
        if stored is not None and self.lookahead is not None:
            plans = self.lookahead.all_as_stored(arrays["stored"]).transpose(1, 2, 0).copy()
        decided = self.decide_columns(columns[0], errors, columns[1], plans)
        return decided._replace(
            input=np.array(decided.input.T, order="C"),
            reason=np.array(REASONS)[decided.reason],
            plan=decided.plan.transpose(2, 0, 1),
        )

    def first_plan(self, estimate: np.ndarray, errors: PredictedErrors) -> np.ndarray:
        """Returns a certified plan that may be stored before the first decision, shape (k, m); empty without one."""
        if self.lookahead is None:
            return self._no_plan
        first = self.decide(estimate, errors, self._gained(_as_column(estimate, self.plant.n))[:, 0])
        return np.concatenate([first.input[None], first.plan]) if first.proved else self._no_plan

    def errors_of(self, error_shape: Any) -> PredictedErrors:
        """Returns what is known of one error shape, (n, n), without a last axis, read-only; itself if it is that.

        It is remembered, since shapes recur.
        """
        if isinstance(error_shape, PredictedErrors):
            return error_shape
        shape = _as_array(error_shape)
        key = shape.tobytes() if shape.shape == (self.plant.n, self.plant.n) else b""
        known = self._remembered.get(key)
        if known is None:
            # Of what the key says: somebody may write into the shape.
            usable = np.frombuffer(key) if key else np.full(self.plant.n**2, np.nan)
            known = self.errors_of_many(usable.reshape(1, self.plant.n, self.plant.n)).single().read_only()
            if len(self._remembered) >= MOST_REMEMBERED:
                self._remembered.clear()
            self._remembered[key] = known
        return known

    @np.errstate(all="ignore")  # what is not finite is unusable
    def errors_of_many(self, error_shapes: np.ndarray) -> PredictedErrors:
        """Returns what is known of error shapes, (k, n, n); only mode "lookahead" needs the shapes themselves."""
        known = self.test.predicted(error_shapes, self.certificate.error_shapes)
        return known if self.lookahead is not None else known._replace(shape=known.shape[:0])

    def margin(self, estimate: np.ndarray, error_shape: np.ndarray | PredictedErrors, u: np.ndarray) -> float:
        """Returns the margin of an input u, shape (m,), as `Decision` defines it; NaN if any argument is unusable."""
        x_hat, u = _as_column(_as_array(estimate), self.plant.n), _as_column(_as_array(u), self.plant.m)
        return self.test.reachable(x_hat, self.errors_of(error_shape).batch()).margins(u)[1].item()

    def knows_inside(self, estimate: np.ndarray, error_shape: np.ndarray | PredictedErrors) -> bool:
        """Returns whether estimate and error shape prove that x is in the certificate's safe set."""
        x_hat, errors = _as_array(estimate), self.errors_of(error_shape)
        return x_hat.shape == (self.plant.n,) and bool(self.test.knows_inside(x_hat, errors, MARGIN))

    def _project(self, decided: Decision, some: np.ndarray, sets: ReachableSets) -> None:
        """Puts the closest input that passes, where there is one, in the place of some of those decided."""
        if some.size:
            sets = sets.some(some)
            closest = self._expressible(sets.closest(decided.input[:, some], self.projection_margin))
            test_margin, margin = sets.margins(closest)
            found = test_margin >= MARGIN
            some = some[found]
            decided.input[:, some], decided.margin[some] = closest[:, found], margin[found]
            decided.proved[some], decided.reason[some] = True, PROJECTED

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
            test_margin, margin = sets.margins(applied)
            decided.input[:, some], decided.margin[some] = applied, margin
            decided.intervened[some], decided.proved[some] = differs, test_margin >= MARGIN
            unsafe = (applied != gained).any(axis=0)
            decided.fallback[some] = exists & ~unsafe
            reason = np.where(unsafe, UNSAFE, FALLBACK)
            decided.reason[some] = np.where(valid & ~np.isnan(sets.radius), reason, INVALID)

    def _gained(self, estimates: np.ndarray) -> np.ndarray:
        """Returns K x_hat as actions can express it, shape (m, N); NaN where it cannot be computed."""
        gained = self.certificate.K @ estimates + self._constant
        return np.where(np.isfinite(gained).all(axis=0), self._expressible(gained), np.nan)

    def _expressible(self, inputs: np.ndarray) -> np.ndarray:
        return expressible(inputs.T, self.plant).T


def plan_horizon(mode: str, horizon: int | None) -> int | None:
    """Returns the length of the longest plans of a mode [steps]; None for those that plan nothing.

    Raises:
        ValueError: If there is no such mode, or the horizon is wrong.
    """
    if not (isinstance(mode, str) and mode in MODES):
        raise ValueError(f"mode must be one of {list(MODES)}, got {shown(mode)}")
    if mode != "lookahead":
        if horizon is not None:
            raise ValueError(f'horizon is for mode "lookahead", mode {mode!r} takes none')
        return None
    return as_count(DEFAULT_HORIZON if horizon is None else horizon, "horizon", low=1, high=LONGEST_HORIZON)


def _as_array(value: Any) -> np.ndarray:
    """Returns float64 numbers; an empty array, which has no usable shape, for what are none."""
    if type(value) is np.ndarray and value.dtype is FLOAT64:  # the common case, without another call
        return value
    return np.empty(0) if (array := as_numbers(value)) is None else array


def _as_column(array: np.ndarray, size: int) -> np.ndarray:
    """Returns a batch of one, shape (size, 1); NaN for an array of another shape."""
    return array[:, None] if array.shape == (size,) else np.full((size, 1), np.nan)
