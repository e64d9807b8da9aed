"""Filter and monitor of a loop, or of N: what is applied in place of what is proposed, what is proved, why not."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import hypot
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import Channel, Ellipsoid
from ncs_gym.estimation.arrival_histories import ErrorTable
from ncs_gym.estimation.estimator import Belief
from ncs_gym.network.channel import largest_age, warn_of_broken_contract
from ncs_gym.network.downlink import IDEAL_DOWNLINK, CommittedInputs, DownlinkProtocol
from ncs_gym.plants.linear_plant import SIMULATED_REACH
from ncs_gym.validation import CopiedWhole, frozen, shown, warn_caller
from shields.errors import GuaranteeLostError, GuaranteeLostWarning
from shields.runtime.safety_filter import MARGIN, MOST_REMEMBERED, Decision, SafetyFilter
from shields.runtime.set_test import FARTHEST, PredictedErrors, norms
from shields.runtime.starts import StartKnown, first_store, known_inside, starts_known

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


# By code, for the codes of many loops.
_EXPLANATIONS = np.array(EXPLANATIONS, dtype=object)


class Guard(CopiedWhole):
    """Decides the inputs of a loop and follows whether they prove that its state stays in S, or in the box.

    It stands inside the loop, where nothing comes between what is decided and what is applied, and knows what a
    controller can know. Every step is one `decide` and one `observe`. Its claim asks that one input was decided and the
    loop moved one step between two observations, and that the input applied is the one that was due.

    Args:
        safety_filter: Makes the decisions.
        downlink: How commands are sent. What is observed belongs to the time at which the next input takes effect.
        on_unproved: "warn", "raise" or "ignore"; see `LostGuarantee`.
        size: N; None for one loop, whose values are numbers in place of arrays.

    Attributes:
        filter: The same.
        input_delay: c, the number of steps from a decision to its effect.
        lost: Says that states are not proved safe.
        penalty: Subtracted from the reward per intervention.
        belief: What was observed last.
        errors: What follows from the error shape of its estimate.
        stored: What is left of plans of mode "lookahead": shape (k, m), or (horizon, m, N), NaN beyond their ends.
    """

    def __init__(
        self, safety_filter: SafetyFilter, downlink: DownlinkProtocol, on_unproved: str, size: int | None = None
    ) -> None:
        m = safety_filter.plant.m
        self.filter, self.input_delay = safety_filter, downlink.input_delay
        self.lost, self.penalty = LostGuarantee(on_unproved, size or 1), 0.0
        self._monitor = GuaranteeMonitor(safety_filter, downlink)
        self._errors_of = NumberedErrors(safety_filter)
        self._schedule = None
        if downlink.channel is not None:
            self._schedule = CommittedInputs(self.input_delay, m if size is None else (m, size))
        self._channels: set[Channel] = set()
        self._size, self._idle = size, np.zeros(m if size is None else (m, size))
        # What the last start was known to lie in, and what follows from it exactly.
        self._start: Any = None
        self._known: tuple[StartKnown, ...] = ()
        # False, 0 and "" of one loop, arrays of many; nobody writes into them.
        none: Any = False
        zero: Any = 0
        self._no_reason: Any = ""
        self.stored = np.empty((0, m))
        if size is not None:
            none, zero = np.zeros(size, np.bool_), np.zeros(size, np.int64)
            self._no_reason = frozen(np.full(size, "", dtype=object))
            self.stored = np.full((safety_filter.horizon or 0, m, size), np.nan)
        # What was decided last of what was proposed.
        self._decision, self._proposed = Decision(self._idle, none, none, none, 0.0 * zero, none), self._idle
        self._state = MonitorState(zero, none, none, none, zero)
        # The clock of the loop when it was observed last, and how many inputs were decided since.
        self._moves: Any = zero
        self._asked = 0
        # What this episode has of interventions, of states and of those proved, and which loops the next `info` counts.
        self._interventions = self._count = self._proved = zero
        self._counted: Any = True

    belief: Belief
    errors: PredictedErrors

    def begin(
        self,
        belief: Belief,
        starts: Any,
        earlier: Sequence[tuple[np.ndarray, Any]],
        channels: Sequence[Channel] = (),
        mask: Any = None,
    ) -> None:
        """Begins an episode, or those of N loops that a mask, shape (N,), chooses; see `LoopState.beginning`."""
        self.look_at(channels)
        self.lost.begin(slice(None) if mask is None else mask)
        self.belief, self.errors = belief, self._errors_of.of(belief.table, belief.number)
        none: Any = False
        if mask is None:
            known = self._known_of(starts)
            self.stored, is_safe = first_store(self.filter, belief.estimate, self.errors, known[-1])
            self._state = self._covered(self._monitor.start(is_safe, belief, self.errors), [known], earlier)
            margin: Any = self.filter.margin(belief.estimate, self.errors, self._idle)
            self._interventions = self._proved = self._count = 0
        else:
            chosen, none = np.flatnonzero(mask), np.zeros(len(mask), np.bool_)
            self._leave(~mask & ((belief.moves != self._moves) | (self._asked > 0)))
            all_known = [self._known_of(start) for start in starts]
            is_safe = none.copy()
            is_safe[chosen] = [known[-1].in_safe_set for known in all_known]
            if self.filter.horizon:
                self.stored = self.stored.copy()
                self.stored[..., chosen] = np.nan
                for e, known in zip(chosen.tolist(), all_known, strict=True):
                    alone = belief.estimate[:, e].copy(), self.errors.single(e)
                    plan, is_safe[e] = first_store(self.filter, *alone, known[-1])
                    self.stored[: len(plan), :, e] = plan
            all_started = self._monitor.start(is_safe, belief, self.errors)
            started = MonitorState(*(np.broadcast_to(each, mask.shape)[chosen] for each in all_started))
            self._state = MonitorState(*map(np.array, self._state))
            for kept, new in zip(self._state, self._covered(started, all_known, earlier), strict=True):
                kept[chosen] = new
            margin = self._decision.margin.copy()
            sets = self.filter.test.reachable(belief.estimate[:, chosen], self.errors.of(chosen))
            margin[chosen] = sets.margins(self._idle[:, chosen])[1]
            self._counted, goes_on = mask, ~mask
            self._count, self._proved = self._count * goes_on, self._proved * goes_on
            self._interventions = self._interventions * goes_on
        self._moves, self._asked = belief.moves, 0
        if self._schedule is not None:
            self._schedule.start(mask)
        self._decision, self._proposed = Decision(self._idle, none, none, none, margin, none), self._idle

    def _covered(
        self, state: MonitorState, known: list[tuple[StartKnown, ...]], earlier: Sequence[tuple[np.ndarray, Any]]
    ) -> MonitorState:
        """Returns the state at starts with what is known of the steps before the first decision takes effect."""
        steps = []
        for ahead, (estimate, number) in enumerate(earlier):
            errors = self._errors_of.of(self.belief.table, number)
            if self._size is None:
                inside: Any = known_inside(self.filter, known[0][ahead], estimate, errors)
            else:
                alone = [(each[ahead], estimate[:, k].copy(), errors.single(k)) for k, each in enumerate(known)]
                inside = np.array([known_inside(self.filter, *each) for each in alone], np.bool_)
            quiet = self.belief._replace(estimate=estimate, number=number, alarm=False, damaged=False, outside=False)
            steps.append((inside, quiet, errors))
        return self._monitor.cover(state, steps) if steps else state

    def _known_of(self, start: Any) -> tuple[StartKnown, ...]:
        """Returns `starts_known`; of sets, which are read-only and recur, it is remembered: it takes long."""
        if not isinstance(start, Ellipsoid):
            return starts_known(self.filter, start, self.input_delay)
        if start is not self._start:
            self._start, self._known = start, starts_known(self.filter, start, self.input_delay)
        return self._known

    def decide(self, proposed: np.ndarray) -> Decision:
        """Returns what is decided of inputs, shape (m,) or (m, N), at the belief observed last; never raises."""
        given = self.belief.estimate, self.errors, proposed, self.stored
        if self._size is None:
            decision = self.filter.decide_alone(*given) or self.filter.decide(*given)
        else:
            decision, self._counted = self.filter.decide_columns(*given), True
        self._decision, self._proposed, self._asked = decision, proposed, self._asked + 1
        self.stored = decision.plan.copy()
        return decision

    def observe(self, belief: Belief) -> None:
        """Takes in what is known after the step that followed the decision."""
        decided, schedule = self._decision.input, self._schedule
        if schedule is None:
            on_time, same_input = True, _equal(belief.applied, decided)
        else:
            on_time = _equal(belief.applied, schedule.due(decided))
            same_input = _equal(belief.committed, decided)
        moved_once = (belief.moves == self._moves + 1) & (self._asked == 1)
        self._moves, self._asked = belief.moves, 0
        if (goes_on := moved_once & same_input & on_time) is not True:
            self._drop(goes_on)
        self.belief, self.errors = belief, self._errors_of.of(belief.table, belief.number)
        happened = self._decision, moved_once, same_input, belief, self.errors, on_time
        self._state = self._monitor.advance(self._state, *happened)

    @property
    def code(self) -> Any:
        """Why the state is not proved safe now, an index of `EXPLANATIONS` or shape (N,); 0 while it is."""
        return self._monitor.reasons(self._state, self.belief.age)

    def look_at(self, channels: Sequence[Channel]) -> None:
        """Warns the caller of channels that are new and break the contract of the certificate."""
        present = set(channels)
        for channel in present - self._channels:
            warn_of_broken_contract(self.filter.certificate.contract, channel, self.input_delay)
        self._channels = present

    def info(self) -> dict[str, Any]:
        """Returns the keys of `info`, and counts: once after each `begin` or `observe`."""
        decided, proposed, size = self._decision, self._proposed, self._size
        code = self._monitor.reasons(self._state, self.belief.age)
        is_proved = not code if size is None else code == 0
        self._count, self._proved = self._count + self._counted, self._proved + (is_proved & self._counted)
        self._interventions = self._interventions + decided.intervened
        doubted = code if size is None else np.count_nonzero(code)
        if doubted:
            self.lost.note(code, 0 if size is None else np.arange(size))
        if size is None:
            corrected = hypot(*(decided.input - proposed).tolist()) if decided.intervened else 0.0
        else:
            corrected = norms(decided.input - proposed)
        told = {
            "shield_intervened": decided.intervened,
            "input_proposed": proposed.T,
            "shield_correction": corrected,
            "shield_margin": decided.margin,
            "shield_guaranteed": is_proved,
            "shield_reason": _EXPLANATIONS[code] if doubted else self._no_reason,
            "episode_interventions": self._interventions,
            "episode_guaranteed": self._proved / self._count,
        }
        if self.filter.horizon:
            stored = self.stored
            told["shield_plan_length"] = (
                len(stored) if size is None else np.count_nonzero(~np.isnan(stored[:, 0]), axis=0)
            )
        if size is None:
            told["input_proposed"] = proposed.copy()
            return told
        return {key: value.copy() for key, value in told.items()}

    def _leave(self, strayed: np.ndarray) -> None:
        """Ends the proof of loops that moved without this guard."""
        if np.count_nonzero(strayed):
            self._state = self._state._replace(broken=first_broken(self._state.broken, strayed, OTHER_STEPS))
            self._drop(~strayed)

    def _drop(self, goes_on: Any) -> None:
        """Drops plans that were certified for other states than those that follow."""
        if self._size is None:
            self.stored = self.stored if goes_on else self.stored[:0]
        elif len(self.stored):
            self.stored[..., ~goes_on] = np.nan


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

    S is the certificate's safe set, a polytope or an ellipsoid. In mode "lookahead" it is whether x
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
        self._within_step = len(plant.step_rows) > 0
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
        # A passed test proves the limits within the step and the next state; the first one needs x itself in the box.
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
        return MonitorState(broken, inside, errors.certified, errors.stays, wait)


def longer_wait(wait: Any, proved: Any, ahead: int) -> Any:
    """Returns after how many steps x is proved at present: at least `wait`, of single loops or arrays of many.

    At step k that takes x_k .. x_{k+c} and the ways that lead to them (docs/shield_proof.md, "Who proves what"). Where
    x_{k+ahead} or the way to it is not `proved`, nothing is until that is over, ahead + 1 steps from now.
    """
    return np.maximum(wait, _not(proved) * (ahead + 1))


class NumberedErrors:
    """What a filter knows of the error shapes of estimators, by the numbers that these have for them.

    A number belongs to a table, in which it never changes its meaning; with another table all is looked up anew.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        self._filter = safety_filter
        self._table: ErrorTable | None = None
        self._alone: dict[int, PredictedErrors] = {}
        self._known: PredictedErrors

    def of(self, table: ErrorTable, number: Any) -> PredictedErrors:
        """Returns what is known of an error shape, without a last axis, or of N, numbers of shape (N,)."""
        if table is not self._table:
            self._alone, self._known = {}, self._filter.errors_of_many(table.shapes[:0])
            self._table = table  # last: if this is interrupted, nothing is known of either table
        if isinstance(number, np.ndarray):
            return self._many(table, number)
        errors = self._alone.get(number)
        if errors is None:
            if len(self._alone) >= MOST_REMEMBERED:
                self._alone.clear()
            errors = self._filter.errors_of(table.shape(number))._replace(stays=table.is_certified(number))
            self._alone[number] = errors
        return errors

    def _many(self, table: ErrorTable, numbers: np.ndarray) -> PredictedErrors:
        known, shapes = self._known, table.shapes
        if (count := len(known.radius)) < len(shapes):
            more = self._filter.errors_of_many(shapes[count:])._replace(stays=table.certified[count : len(shapes)])
            known = self._known = known.followed_by(more)
        return known.of(numbers)


def _equal(taken: np.ndarray, decided: np.ndarray) -> Any:
    """Returns whether inputs are equal: a truth value for shape (m,), an array (N,) for (m, N)."""
    return taken.tolist() == decided.tolist() if taken.ndim == 1 else (taken == decided).all(axis=0)


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
