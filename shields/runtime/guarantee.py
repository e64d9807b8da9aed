"""Follows, step by step, whether the proof of safety holds, for one control loop or for many; says where it is lost."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.envs.report import Belief
from ncs_gym.network.contract import largest_age
from ncs_gym.network.downlink import IDEAL_DOWNLINK, DownlinkProtocol
from ncs_gym.plants.linear_plant import SIMULATED_REACH
from ncs_gym.validation import shown, warn_caller
from shields.errors import GuaranteeLostError, GuaranteeLostWarning
from shields.runtime.decisions import Decision
from shields.runtime.safety_filter import MARGIN, SafetyFilter
from shields.runtime.set_test import FARTHEST, PredictedErrors

ALARM = "a measurement contradicts the assumed bounds"
OUTSIDE_BOUND = "the simulation saw a step outside the bound on disturbances of the model"
NOT_FINITE = "a sample held NaN or infinity: where a sensor has no reading, no packet may be sent"
OTHER_INPUT = "the input applied is not the one decided"
OTHER_STEPS = "the environment did not move exactly one step"
LARGE_ERROR = "the error ellipsoid is not inside a certified one to stay"
OLD_SAMPLE = "the newest sample used is older than the contract allows"
FAR_OUT = "the estimate is so far out of the safe box that rounding counts"
UNUSABLE = "there is no usable estimate or error shape"
NOT_KNOWN_INSIDE = "the state is not known to be in the safe set"
LEFT_MODEL = "the state is not known to have stayed where the bound of the linear model's remainder holds"
LATE_INPUT = "the downlink broke its contract: an input decided earlier was not applied"
NO_DOWNLINK_CONTRACT = "the downlink has no contract: nothing says that inputs arrive in time"
# Of loops that learn from echoes what was applied; no monitor says so.
NOT_CONFIRMED = "the actuator has not confirmed for too long that it applies what is decided"
OTHER_EPISODE = "the actuator echoes inputs of another episode: tell it the episode of the loop"
# Codes of `GuaranteeMonitor.reasons`; 0 while the proof holds.
EXPLANATIONS = (
    "", ALARM, OTHER_INPUT, OTHER_STEPS, LARGE_ERROR, FAR_OUT, UNUSABLE, NOT_KNOWN_INSIDE,
    LEFT_MODEL, LATE_INPUT, NO_DOWNLINK_CONTRACT, OLD_SAMPLE, NOT_CONFIRMED, NOT_FINITE,
    OTHER_EPISODE, OUTSIDE_BOUND,
)  # fmt: skip
CODES = {explanation: code for code, explanation in enumerate(EXPLANATIONS)}
ON_UNPROVED = ("ignore", "warn", "raise")


class MonitorState(NamedTuple):
    """What a monitor knows about one control loop; about N of them, arrays of shape (N,).

    Attributes:
        broken: Code of what broke the proof for the rest of the episode; 0 for nothing.
        inside: Whether x in S is proved, up to what broke; in mode "lookahead" also if x is proved in the box and the
            inputs stored are what is left of a certified plan.
        certified: Whether the error ellipsoid lies inside a certified one.
        stays: Whether it is known to stay there while the contract is kept.
        wait: Number of steps until x in S is proved at present, if all that follows is (`longer_wait`). Behind a
            downlink `inside` is about the time at which the next input takes effect. 0 where neither that nor ways
            between samples count.
    """

    broken: Any
    inside: Any
    certified: Any
    stays: Any
    wait: Any = 0


class GuaranteeMonitor:
    """Whether x in S is proved now, and why not (docs/shield.md, "How you see that an assumption broke").

    S is the certificate's safe set: its polytope, or its ellipsoid if it has none. In mode "lookahead" it is whether x
    is in the box now and stays there: "in S, or in the box with a certified tail stored". The caller keeps the store
    from decision to decision, and drops it where another input is applied.

    An alarm of the innovation monitor, an input other than the decided one, a step that is not one step and an estimate
    so far out that rounding counts break the error bound for the rest of the episode. The others are recoverable: a
    passed test proves the next state in S without x in S, and a running ellipsoid outside E(Sigma) is still a bound,
    only K x_hat is not proved safe with it. Of a plant with a remainder nothing is recoverable: its error bound holds
    only while every state so far is proved to be in the box (docs/beyond_linear.md).

    Behind a downlink `inside` is about the time at which the next input takes effect; it is proved for the present as
    soon as it was proved for this time, c steps ago.

    Methods are functions of a state and of what happened, truth values for one loop and arrays (N,) for many.

    Args:
        safety_filter: Makes the decisions.
        downlink: How commands are sent.
    """

    def __init__(self, safety_filter: SafetyFilter, downlink: DownlinkProtocol = IDEAL_DOWNLINK) -> None:
        plant, certificate = safety_filter.plant, safety_filter.certificate
        self._input_delay = downlink.input_delay
        self._within_step = plant.grid_rows is not None or len(plant.mixed_rows) > 0
        self._is_promised = downlink.contract is not None
        self._test = safety_filter.test
        # The present estimate, which is not observed then, is near where what was predicted of it is nearer still.
        self._reach = SIMULATED_REACH * plant.half_widths / (2.0 if self._input_delay else 1.0)
        # Of the newest sample at present, while the contract of the certificate holds.
        self._largest_age = largest_age(certificate.contract) - self._input_delay
        self._is_local = plant.remainder is not None
        # S holds inputs under way beyond their limits, where a remainder has no bound; only a start can have them.
        self._under_way = plant.past if self._is_local else 0
        self._limits = np.tile([plant.input_middle, plant.input_half], self._under_way // plant.m)

    def start(self, known_inside: Any, belief: Belief, errors: PredictedErrors) -> MonitorState:
        """Returns the state at the start of an episode.

        Args:
            known_inside: Whether every possible start lies in S, or in the box with a certified plan stored.
            belief: What is known.
            errors: What follows from the error shape of the estimate.
        """
        broken = self._within_limits(known_inside * 0, belief.estimate, errors)
        return self._observe(broken, known_inside, belief, errors, 0)

    def cover(self, state: MonitorState, earlier: Iterable[tuple[Any, Belief, PredictedErrors]]) -> MonitorState:
        """Returns the state at the start with what is known of the steps before the first decision takes effect.

        That is of x_0 .. x_{c-1} whether it is known to be in S, and the way from it in the box (`known_inside`), and
        what is known of its estimate.
        """
        broken, wait = state.broken, state.wait
        for ahead, (inside, belief, errors) in enumerate(earlier):
            broken = self._within_limits(broken, belief.estimate, errors)
            seen = self._observe(broken, inside, belief, errors, 0)
            broken = seen.broken
            if self._within_step:  # what is not proved of x_j is not of the way to x_{j+1}
                wait = longer_wait(wait, inside & seen.inside, ahead + 1)
            else:
                wait = longer_wait(wait, seen.inside, ahead)
        return state._replace(broken=broken, wait=wait)

    def advance(
        self,
        state: MonitorState,
        decision: Decision,
        moved_once: Any,
        same_input: Any,
        belief: Belief,
        errors: PredictedErrors,
        on_time: Any = True,
    ) -> MonitorState:
        """Returns the state one step later.

        Args:
            state: Before the step.
            decision: What was decided then.
            moved_once: Whether the loop moved exactly one step.
            same_input: Whether the input applied is the one decided.
            belief: What is known after the step.
            errors: What follows from the error shape of the estimate.
            on_time: Behind a downlink, whether the input applied is the one decided for this step.
        """
        broken = state.broken
        if moved_once is not True:
            broken = first_broken(broken, _not(moved_once), OTHER_STEPS)
        if same_input is not True:
            broken = first_broken(broken, _not(same_input), OTHER_INPUT)
        if on_time is not True:
            broken = first_broken(broken, _not(on_time), LATE_INPUT)
        inside = decision.proved
        if inside is not True and not _all(inside):
            # A stored plan was certified for every error that it can meet: it needs no certified error set on its way.
            inside = inside | state.inside & (state.certified & decision.fallback | decision.stored)
        # A passed test proves the times on the grid and the next state; the first one needs x itself in the box.
        on_the_way = inside & state.inside if self._within_step else True
        return self._observe(broken, inside, belief, errors, state.wait, on_the_way)

    def reasons(self, state: MonitorState, age: Any = 0) -> Any:
        """Returns why the proof does not hold now, as indices of `EXPLANATIONS`: 0 while it does.

        The age of the newest sample used tells a broken contract from other large errors.
        """
        reason = state.broken
        if not self._is_promised:
            reason = first_broken(reason, True, NO_DOWNLINK_CONTRACT)
        if state.inside is not True:
            reason = first_broken(reason, _not(state.inside), NOT_KNOWN_INSIDE)
        if self._input_delay or self._within_step:
            reason = first_broken(reason, state.wait > 0, NOT_KNOWN_INSIDE)
        lasts = state.certified & state.stays
        if lasts is True or _all(lasts):
            return reason
        is_large = _not(lasts)
        reason = first_broken(reason, is_large & (age > self._largest_age), OLD_SAMPLE)
        return first_broken(reason, is_large, LARGE_ERROR)

    def _within_limits(self, broken: Any, estimate: np.ndarray, errors: PredictedErrors) -> Any:
        if not self._under_way:
            return broken
        middle, half = self._limits if estimate.ndim == 1 else self._limits[..., None]
        stored, widths = estimate[-self._under_way :], errors.half_widths[-self._under_way :]
        return first_broken(broken, _not(_rows_all(np.abs(stored - middle) + widths <= half)), LEFT_MODEL)

    def _observe(
        self, broken: Any, inside: Any, belief: Belief, errors: PredictedErrors, wait: Any, on_the_way: Any = True
    ) -> MonitorState:
        """Takes in the alarm, the running ellipsoid, and what the estimate alone proves: not what was on the way."""
        estimate, alarm, damaged = belief.estimate, belief.alarm, belief.damaged
        size = np.abs(estimate)
        reach = self._reach if estimate.ndim == 1 else self._reach[:, None]
        within = size + errors.half_widths <= reach  # never without a usable estimate and error shape
        if alarm is not False or damaged is not False:
            broken = first_broken(
                first_broken(first_broken(broken, damaged, NOT_FINITE), belief.outside, OUTSIDE_BOUND), alarm, ALARM
            )
        if np.count_nonzero(within) < within.size:  # quicker than all()
            near = _rows_all(within)
            usable = (self._test.columns.dot(size) < FARTHEST) & (errors.radius == errors.radius)
            broken = first_broken(first_broken(broken, _not(usable), UNUSABLE), _not(near), FAR_OUT)
        if inside is not True and not _all(inside):
            inside = inside | self._test.knows_inside(estimate, errors, MARGIN)
            if self._is_local:
                broken = first_broken(broken, _not(inside), LEFT_MODEL)
        if self._input_delay or self._within_step:
            wait = longer_wait(np.maximum(wait - 1, 0), inside & on_the_way, self._input_delay)
        return MonitorState(broken, inside, errors.certified, belief.stays, wait)


def longer_wait(wait: Any, proved: Any, ahead: int) -> Any:
    """Returns after how many steps x is proved at present: at least `wait`, of single loops or arrays of many.

    At step k that takes x_k .. x_{k+c} and the ways that lead to them (docs/shield_proof.md, "Who proves what"). Where
    x_{k+ahead} or the way to it is not `proved`, nothing is until that is over, ahead + 1 steps from now.
    """
    return np.maximum(wait, _not(proved) * (ahead + 1))


class LostGuarantee:
    """Says once per episode and reason that the state is not proved safe.

    What is noted is said by `tell`, which comes after everything else in a step: when it raises, the step has happened.

    Args:
        on_unproved: "ignore" says nothing; "warn" warns the first caller outside this package; "raise" raises.
        count: Number of control loops side by side.

    Raises:
        ValueError: If it is none of these.
    """

    def __init__(self, on_unproved: str, count: int = 1) -> None:
        if not (isinstance(on_unproved, str) and on_unproved in ON_UNPROVED):
            raise ValueError(f"on_unproved must be one of {list(ON_UNPROVED)}, got {shown(on_unproved)}")
        self.on_unproved = on_unproved
        self._said = np.zeros((count, len(EXPLANATIONS)), np.bool_)
        self._news: frozenset[int] = frozenset()

    def begin(self, restarted: Any = slice(None)) -> None:
        """Begins episodes, in which nothing has been said, in the loops chosen by a mask or index."""
        self._said[restarted] = False

    def note(self, codes: Any, loops: Any = 0) -> None:
        """Takes in why some loops are not proved safe, as indices of `EXPLANATIONS`: 0 for those that are."""
        if self.on_unproved == "ignore":
            return
        codes = np.asarray(codes)
        fresh = (codes > 0) & ~self._said[loops, codes]
        if np.count_nonzero(fresh):
            self._said[loops, codes] = True
            self._news |= set(codes[fresh].tolist())

    def tell(self) -> None:
        """Says what was noted since the last call and is new.

        Raises:
            GuaranteeLostError: If there is something new and that is to be raised.
        """
        news, self._news = sorted(self._news), frozenset()
        for code in news:
            text = f"the state is not proved safe now: {EXPLANATIONS[code]}"
            if self.on_unproved == "raise":
                raise GuaranteeLostError(text)
            warn_caller(text, GuaranteeLostWarning)

    def tell_of(self, reason: str) -> None:
        """Says why a single loop is not proved safe, unless the reason is empty or was given in this episode."""
        self.note(CODES[reason])
        self.tell()


def _not(condition: Any) -> Any:
    return not condition if isinstance(condition, bool) else ~condition


def _rows_all(conditions: np.ndarray) -> Any:
    """Returns whether all rows hold: a truth value for shape (n,), an array (N,) for (n, N)."""
    return np.count_nonzero(conditions) == len(conditions) if conditions.ndim == 1 else conditions.all(axis=0)


def _all(conditions: Any) -> bool:
    return conditions is True or np.count_nonzero(conditions) == np.size(conditions)


def first_broken(broken: Any, condition: Any, explanation: str) -> Any:
    """Returns the code of what broke first: that of the explanation where nothing had and the condition holds."""
    if condition is False or not np.count_nonzero(condition):  # the usual case
        return broken
    return broken + (broken == 0) * condition * CODES[explanation]
