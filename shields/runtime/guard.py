"""Filter and monitor of a loop, or of N: what is applied in place of what is proposed, and what is proved of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import hypot
from typing import Any

import numpy as np

from ncs_gym import Channel, Ellipsoid
from ncs_gym.envs.report import Beginning, Belief
from ncs_gym.network.contract import warn_of_broken_contract
from ncs_gym.network.downlink import CommittedInputs, DownlinkProtocol
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
from shields.runtime.safety_filter import NumberedErrors, SafetyFilter
from shields.runtime.set_test import PredictedErrors, norms
from shields.runtime.starts import StartKnown, first_store, known_inside, starts_known

# By code, for the codes of many loops.
_EXPLANATIONS = np.array(EXPLANATIONS, dtype=object)


class Guard(CopiedWhole, ABC):
    """Decides the inputs of a loop and follows whether they prove that its state stays in S, or in the box.

    It stands inside the loop, where nothing comes between what is decided and what is applied, and knows what a
    controller can know. Every step is one `input` and one `observe`. Its claim asks that one input was decided and the
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

    belief: Belief
    errors: PredictedErrors
    # What was decided last of what was proposed, and what is left of the plans of mode "lookahead".
    _decision: Decision
    _proposed: np.ndarray
    _stored: np.ndarray
    _state: MonitorState
    # The clock of the loop when it was observed last, and how many inputs were decided since.
    _moves: Any
    _asked = 0
    # What this episode has of interventions, of states and of those proved, and which loops the next `info` counts.
    _interventions: Any
    _count: Any
    _proved: Any
    _counted: Any = True
    _no_reason: Any = ""

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
        told = {"shield_plan_length": self._plan_length()} if self.filter.horizon else {}
        told |= {
            "shield_intervened": decided.intervened,
            "input_proposed": proposed.T,
            "shield_correction": corrected,
            "shield_margin": decided.margin,
            "shield_guaranteed": is_proved,
            "shield_reason": _EXPLANATIONS[code] if doubted else self._no_reason,
            "episode_interventions": self._interventions,
            "episode_guaranteed": self._proved / self._count,
        }
        if size is None:
            told["input_proposed"] = proposed.copy()
            return told
        return {key: value.copy() for key, value in told.items()}

    def _covered(
        self, state: MonitorState, earlier: Sequence[tuple[np.ndarray, Any]], insides: Sequence[Any]
    ) -> MonitorState:
        """Returns the state with what is known of the steps before the first decision takes effect."""
        known = []
        for (estimate, number), inside in zip(earlier, insides, strict=True):
            quiet = self.belief._replace(estimate=estimate, number=number, alarm=False, damaged=False, outside=False)
            known.append((inside, quiet, self._errors_of.of(quiet.table, number)))
        return self._monitor.cover(state, known)

    @abstractmethod
    def _plan_length(self) -> Any:
        """Returns how many inputs are stored, an int or shape (N,)."""

    @abstractmethod
    def _drop(self, goes_on: Any) -> None:
        """Drops plans that were certified for other states than those that follow."""


class OneGuard(Guard):
    """The guard of one loop."""

    def __init__(self, safety_filter: SafetyFilter, downlink: DownlinkProtocol, on_unproved: str) -> None:
        super().__init__(safety_filter, downlink, on_unproved)
        self._start: Any = None
        self._known: tuple[StartKnown, ...] = ()

    def begin(self, beginning: Beginning, mask: Any = None) -> None:
        """Begins an episode."""
        belief, start, earlier, channels = beginning
        if start is not self._start:  # decided exactly, which takes longer than a step; starts are read-only
            self._start, self._known = start, starts_known(self.filter, start, self.input_delay)
        self.look_at(channels)
        self.start(belief, self._known, earlier)
        self.lost.begin()
        self._interventions = self._proved = self._count = 0
        margin = self.filter.margin(belief.estimate, self.errors, self._idle)
        self._decision, self._proposed = Decision(self._idle, False, False, False, margin, ""), self._idle

    def start(self, belief: Belief, known: Sequence[StartKnown], earlier: Sequence[tuple[np.ndarray, int]]) -> None:
        """Begins to follow whether the state is proved safe, at the start of an episode.

        Args:
            belief: What is known; nobody writes into its estimate.
            known: What is known of x_0 .. x_c (`starts_known`).
            earlier: Estimates of x_0 .. x_{c-1}, before the first decision takes effect, and numbers of their errors.
        """
        self.belief, self.errors = belief, self._errors_of.of(belief.table, belief.number)
        self._moves, self._asked = belief.moves, 0
        self._stored, is_safe = first_store(self.filter, belief.estimate, self.errors, known[-1])
        self._state = self._monitor.start(is_safe, belief, self.errors)
        if self._schedule is not None:
            self._schedule.start()
            insides = [
                known_inside(self.filter, each, mean, self._errors_of.of(belief.table, number))
                for each, (mean, number) in zip(known[:-1], earlier, strict=True)
            ]
            self._state = self._covered(self._state, earlier, insides)

    def decide(self, proposed: np.ndarray) -> Decision:
        """Returns the decision about a proposed input, shape (m,), at the belief observed last; never raises."""
        given = self.belief.estimate, self.errors, proposed, self._stored
        decision = self.filter.decide_alone(*given) or self.filter.decide(*given)
        self._decision, self._proposed, self._asked = decision, proposed, self._asked + 1
        self._stored = decision.plan.copy() if len(decision.plan) else decision.plan
        return decision

    def input(self, u: np.ndarray) -> np.ndarray:
        """Returns the input to apply in place of a proposed one, shape (m,): itself if it may act."""
        decision = self.decide(u)
        return decision.input if decision.intervened else u

    def _plan_length(self) -> int:
        return len(self._stored)

    def plan(self) -> np.ndarray:
        """Returns the inputs stored for the steps to come, shape (k, m)."""
        return self._stored.copy()

    def _drop(self, goes_on: bool) -> None:
        if not goes_on:
            self._stored = self._stored[:0]


class ManyGuards(Guard):
    """The guard of N loops, the last axis of every array; `initial_set` has the starts that no option gave."""

    def __init__(
        self,
        safety_filter: SafetyFilter,
        downlink: DownlinkProtocol,
        initial_set: Ellipsoid,
        on_unproved: str,
        size: int,
    ) -> None:
        super().__init__(safety_filter, downlink, on_unproved, size)
        self._drawn = starts_known(safety_filter, initial_set, self.input_delay)
        self._none = none = np.zeros(size, np.bool_)
        self._state = MonitorState(np.zeros(size, np.int64), none, none, none, np.zeros(size, np.int64))
        self._moves = np.zeros(size, np.int64)
        self._interventions, self._proved, self._count = np.zeros((3, size), np.int64)
        self._decision = Decision(self._idle, none, none, none, np.zeros(size), none)
        # Plans stored in mode "lookahead", NaN beyond their ends.
        self._stored = np.full((safety_filter.horizon or 0, *self._idle.shape), np.nan)
        self._no_reason = np.full(size, "", dtype=object)
        self._no_reason.flags.writeable = False

    def begin(self, beginning: Beginning, mask: Any = None) -> None:
        """Begins episodes where `mask`, shape (N,), says so."""
        belief, starts, earlier, channels = beginning
        chosen, none = np.flatnonzero(mask), self._none
        self.look_at(channels)
        self.lost.begin(mask)
        self.belief, self.errors = belief, self._errors_of.of(belief.table, belief.number)
        known = [self._drawn] * len(mask)
        for e in np.flatnonzero(mask & ~np.isnan(starts[:, 0])).tolist():
            known[e] = starts_known(self.filter, starts[e], self.input_delay)
        is_safe = np.array([each[-1].in_safe_set for each in known])
        if len(self._stored):
            self._stored[..., mask] = np.nan
            for e in chosen.tolist():
                estimate, errors = belief.estimate[:, e].copy(), self.errors.single(e)
                plan, is_safe[e] = first_store(self.filter, estimate, errors, known[e][-1])
                self._stored[: len(plan), :, e] = plan
        self._leave(~mask & ((belief.moves != self._moves) | (self._asked > 0)))
        self._moves, self._asked = belief.moves, 0
        started = self._monitor.start(is_safe, belief, self.errors)
        self._state = MonitorState(*(np.where(mask, *both) for both in zip(started, self._state, strict=True)))
        if self._schedule is not None:
            self._schedule.start(mask)
            insides = []
            for ahead, (means, numbers) in enumerate(earlier):
                errors = self._errors_of.of(belief.table, numbers)
                inside = [
                    known_inside(self.filter, known[e][ahead], means[:, k].copy(), errors.single(k))
                    for k, e in enumerate(chosen.tolist())
                ]
                insides.append(np.array(inside, np.bool_))
            covered = self._covered(MonitorState(*(array[chosen] for array in self._state)), earlier, insides)
            for kept, new in zip(self._state, covered, strict=True):
                kept[chosen] = new
        margin, sets = self._decision.margin.copy(), self.filter.test.reachable(*self._some(chosen))
        margin[chosen] = sets.margins(self._idle[:, chosen])[1]
        self._decision, self._proposed = Decision(self._idle, none, none, none, margin, none), self._idle
        self._counted, goes_on = mask, ~mask
        self._count, self._proved = self._count * goes_on, self._proved * goes_on
        self._interventions = self._interventions * goes_on

    def input(self, u: np.ndarray) -> np.ndarray:
        """Returns the inputs to apply in place of proposed ones, shape (m, N)."""
        decided = self.filter.decide_columns(self.belief.estimate, self.errors, u, self._stored)
        self._decision, self._proposed, self._counted = decided, u, ~self._none
        self._stored, self._asked = decided.plan.copy(), self._asked + 1
        return decided.input

    def _plan_length(self) -> np.ndarray:
        return np.count_nonzero(~np.isnan(self._stored[:, 0]), axis=0)

    def _leave(self, strayed: np.ndarray) -> None:
        """Ends the proof of loops that moved without this guard."""
        if np.count_nonzero(strayed):
            self._state = self._state._replace(broken=first_broken(self._state.broken, strayed, OTHER_STEPS))
            self._drop(~strayed)

    def _some(self, chosen: np.ndarray) -> tuple[np.ndarray, PredictedErrors]:
        return self.belief.estimate[:, chosen], self.errors.of(chosen)

    def _drop(self, goes_on: np.ndarray) -> None:
        if len(self._stored):
            self._stored[..., ~goes_on] = np.nan


def _equal(taken: np.ndarray, decided: np.ndarray) -> Any:
    """Returns whether inputs are equal: a truth value for shape (m,), an array (N,) for (m, N)."""
    return taken.tolist() == decided.tolist() if taken.ndim == 1 else (taken == decided).all(axis=0)
