"""A safety filter and its guarantee for one control loop: what the Gymnasium wrapper and the loop without it share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ncs_gym.network import CommittedInputs, DownlinkProtocol
from shields.runtime.decisions import Decision
from shields.runtime.guarantee import EXPLANATIONS, GuaranteeMonitor, LoopObservation, MonitorState
from shields.runtime.safety_filter import NumberedErrors, SafetyFilter
from shields.runtime.starts import StartKnown, first_store, known_inside


class MonitoredFilter:
    """Decides the inputs of one control loop and follows whether they prove that its state stays in S, or in the box.

    In mode "lookahead" the stored plan is kept here from decision to decision.

    Every step is one `decide` and then one `advance`. Nothing here knows where estimates come from.

    Args:
        safety_filter: Makes the decisions.
        downlink: How commands are sent. What is observed belongs to the time at which the next input takes effect.

    Attributes:
        filter: The same.
        errors: What it knows of the error shapes of the loop's estimator.
        input_delay: c, the number of steps from a decision to its effect.
        report: What was observed last.
        decided: Entries of the input decided last, [physical units].
    """

    def __init__(self, safety_filter: SafetyFilter, downlink: DownlinkProtocol) -> None:
        self.filter, self.errors = safety_filter, NumberedErrors(safety_filter)
        self.input_delay = downlink.input_delay
        self._monitor = GuaranteeMonitor(safety_filter, downlink)
        self._schedule = None if downlink.channel is None else CommittedInputs(self.input_delay, safety_filter.plant.m)
        self.report: LoopObservation
        self._state: MonitorState
        self._decision: Decision
        self.decided: list[float] = []
        self._stored: np.ndarray

    def begin(
        self,
        report: LoopObservation,
        known: Sequence[StartKnown],
        unmoved: bool = True,
        is_first: bool = True,
        earlier: Sequence[LoopObservation] = (),
        pending: tuple[np.ndarray, ...] = (),
    ) -> None:
        """Begins an episode, or anew within one.

        Args:
            report: What is observed; nobody writes into its estimate.
            known: What is known of x_0 .. x_c (`starts_known`).
            unmoved: Whether the plant has not moved since.
            is_first: Whether no step of the episode led here.
            earlier: What is known of x_0 .. x_{c-1}, before the first decision takes effect.
            pending: The inputs decided for the next c steps, none of them at the start of an episode.
        """
        self.report = report
        self._stored, is_safe = first_store(self.filter, report.estimate, report.errors, known[-1])
        self._state = self._monitor.start(is_safe, unmoved, report, is_first=is_first)
        if self._schedule is not None:
            self._schedule.start()
            self._schedule.pending = pending or self._schedule.pending
            acting = pending or (None,) * len(earlier)
            inside = [
                known_inside(self.filter, start, each.estimate, each.errors, u)
                for start, each, u in zip(known[:-1], earlier, acting, strict=True)
            ]
            self._state = self._monitor.cover(self._state, zip(inside, earlier, strict=True))

    def decide(self, proposed: np.ndarray) -> Decision:
        """Returns the decision about a proposed input, shape (m,), at the estimate reported last; never raises."""
        self._decision = self.filter.decide(self.report.estimate, self.report.errors, proposed, self._stored)
        self._stored = self._decision.plan.copy() if len(self._decision.plan) else self._decision.plan
        self.decided = self._decision.input.tolist()  # the caller may write into the array
        return self._decision

    def advance(
        self,
        applied: np.ndarray | None,
        moved_once: bool,
        report: LoopObservation,
        committed: np.ndarray | None = None,
    ) -> None:
        """Takes in what happened in the step that followed the decision.

        Args:
            applied: The input applied, shape (m,); None if it is not known.
            moved_once: Whether the plant moved exactly one step.
            report: What is observed after the step.
            committed: Behind a downlink, the input that was committed, shape (m,); None if it is not known.
        """
        on_time, taken = True, applied
        if self._schedule is not None:
            due, taken = self._schedule.due(self.decided), committed
            on_time = applied is not None and applied.tolist() == due.tolist()
        same_input = taken is not None and taken.tolist() == self.decided
        if not (moved_once and same_input and on_time):  # what is stored was certified for other states
            self._stored = self._stored[:0]
        self._state = self._monitor.advance(self._state, self._decision, moved_once, same_input, report, on_time)
        self.report = report

    @property
    def plan_length(self) -> int:
        """Number of inputs stored for the steps to come."""
        return len(self._stored)

    @property
    def reason(self) -> str:
        """Why the state is not proved safe now; empty while it is."""
        return EXPLANATIONS[self._monitor.reasons(self._state, self.report.age)]
