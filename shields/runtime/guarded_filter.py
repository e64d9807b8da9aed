"""A safety filter and its guarantee for one control loop: what the Gymnasium wrapper and the loop without it share."""

from __future__ import annotations

from typing import Any

import numpy as np

from shields.runtime.filter import Decision, SafetyFilter
from shields.runtime.guarantee import EXPLANATIONS, GuaranteeMonitor, MonitorState, Report


class GuardedFilter:
    """Decides the inputs of one control loop and follows whether they prove that its state stays in S.

    Every step is one `decide` and then one `advance`. Nothing here knows where estimates come from.

    Args:
        safety_filter: Makes the decisions.

    Attributes:
        filter: The same.
        report: What was observed last.
        decided: Entries of the input decided last, [physical units].
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        self.filter = safety_filter
        self._monitor = GuaranteeMonitor(safety_filter)
        self.report: Report
        self._state: MonitorState
        self._decision: Decision
        self.decided: list[float] = []

    def begin(self, report: Report, known_inside: bool, unmoved: bool = True) -> None:
        """Begins an episode; the arguments are those of `GuaranteeMonitor.start`."""
        self.report = report
        self._state = self._monitor.start(known_inside, unmoved, report)

    def decide(self, proposed: np.ndarray) -> Decision:
        """Returns the decision about a proposed input, shape (m,), at the estimate reported last; never raises."""
        self._decision = self.filter.decide_knowing(self.report.estimate, self.report.errors, proposed)
        self.decided = self._decision.input.tolist()  # the caller may write into the array
        return self._decision

    def advance(self, applied: np.ndarray | None, moved_once: bool, report: Report) -> None:
        """Takes in what happened in the step that followed the decision.

        Args:
            applied: The input applied, shape (m,); None if it is not known.
            moved_once: Whether the plant moved exactly one step.
            report: What is observed after the step.
        """
        same_input = applied is not None and applied.tolist() == self.decided
        self._state = self._monitor.advance(self._state, self._decision, moved_once, same_input, report)
        self.report = report

    def reported(self, estimate: np.ndarray, error_shape: Any, alarm: bool) -> Report:
        """Returns the report of an estimate, shape (n,), that nobody writes into, and of an error shape, (n, n)."""
        return Report(estimate, self.filter.errors_of(error_shape), alarm)

    @property
    def reason(self) -> str:
        """Why the state is not proved to be in S now; empty while it is."""
        return EXPLANATIONS[self._monitor.reasons(self._state)]
