"""Filter and monitor of a loop, or of N: what is applied in place of what is proposed, and what is proved of it."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import Any

import numpy as np

from ncs_gym import Channel, Ellipsoid
from ncs_gym.envs.report import Belief
from ncs_gym.estimation.error_table import ErrorTable
from ncs_gym.network.actuator import CommittedInputs
from ncs_gym.network.contract import warn_of_broken_contract
from ncs_gym.network.downlink import DownlinkProtocol
from ncs_gym.validation import CopiedWhole
from shields.runtime.decisions import Decision
from shields.runtime.guarantee import (
    EXPLANATIONS,
    OTHER_STEPS,
    GuaranteeMonitor,
    LostGuarantee,
    MonitorState,
    first_broken,
)
from shields.runtime.safety_filter import MOST_REMEMBERED, SafetyFilter
from shields.runtime.set_test import PredictedErrors, norms
from shields.runtime.starts import StartKnown, first_store, known_inside, starts_known

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
        self._no_reason: Any = ""
        # What was decided last of what was proposed.
        self._decision = Decision(self._idle, False, False, False, 0.0, "")
        self._proposed = self._idle
        # The clock of the loop when it was observed last, and how many inputs were decided since.
        self._moves: Any = 0
        self._asked = 0
        # What this episode has of interventions, of states and of those proved, and which loops the next `info` counts.
        self._interventions: Any = 0
        self._count: Any = 0
        self._proved: Any = 0
        self._counted: Any = True
        self.stored = np.empty((0, m))
        self._state = MonitorState(0, False, False, False)
        if size is not None:
            none = np.zeros(size, np.bool_)
            self._state = MonitorState(
                np.zeros(size, np.int64), none, none.copy(), none.copy(), np.zeros(size, np.int64)
            )
            self._moves = np.zeros(size, np.int64)
            self._interventions, self._proved, self._count = np.zeros((3, size), np.int64)
            self.stored = np.full((safety_filter.horizon or 0, m, size), np.nan)
            self._decision = Decision(self._idle, none, none, none, np.zeros(size), none)
            self._no_reason = np.full(size, "", dtype=object)
            self._no_reason.flags.writeable = False

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
            self._state, self.stored = self._started(belief, starts, earlier)
            margin: Any = self.filter.margin(belief.estimate, self.errors, self._idle)
            self._interventions = self._proved = self._count = 0
        else:
            chosen, none = np.flatnonzero(mask), np.zeros(len(mask), np.bool_)
            self._leave(~mask & ((belief.moves != self._moves) | (self._asked > 0)))
            self._state, self.stored = MonitorState(*map(np.array, self._state)), self.stored.copy()
            self.stored[..., chosen] = np.nan
            for k, (e, start) in enumerate(zip(chosen.tolist(), starts, strict=True)):
                before = [(means[:, k].copy(), numbers.item(k)) for means, numbers in earlier]
                state, plan = self._started(belief.column(e), start, before)
                self.stored[: len(plan), :, e] = plan
                for kept, new in zip(self._state, state, strict=True):
                    kept[e] = new
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

    def _started(
        self, belief: Belief, start: Any, earlier: Sequence[tuple[np.ndarray, int]]
    ) -> tuple[MonitorState, np.ndarray]:
        """Returns what is known at the start of one episode, and the plan that is stored then."""
        known, errors = self._known_of(start), self._errors_of.of(belief.table, belief.number)
        plan, is_safe = first_store(self.filter, belief.estimate, errors, known[-1])
        state = self._monitor.start(is_safe, belief, errors)
        if self._schedule is None:
            return state, plan
        ahead = []
        for each, (estimate, number) in zip(known[:-1], earlier, strict=True):
            quiet = belief._replace(estimate=estimate, number=number, alarm=False, damaged=False, outside=False)
            there = self._errors_of.of(belief.table, number)
            ahead.append((known_inside(self.filter, each, estimate, there), quiet, there))
        return self._monitor.cover(state, ahead), plan

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
