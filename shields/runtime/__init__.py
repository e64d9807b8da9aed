"""The shield at run time: which inputs keep the next state safe, what is applied instead, and what is proved.

`safety_filter` decides (`set_test`, `projection`, `backup_plans`), `guard` has it decide and follows whether the proof
of safety holds, for one loop, or for N, the last axis of all arrays; `safe_loop` puts it into a real loop,
`wrapper` into environments.
"""

from typing import Any

from shields.runtime.safe_loop import SafeLoop
from shields.runtime.safety_filter import Decision, SafetyFilter
from shields.runtime.wrapper import SafetyShield, VectorSafetyShield

__all__ = [
    "Decision",
    "SafeLoop",
    "SafetyFilter",
    "SafetyShield",
    "VectorSafetyShield",
]


def _planner(*values: Any) -> Any:
    from shields.runtime.backup_plans import Lookahead  # imported here: other modes need no solver

    return Lookahead(*values)


SafetyFilter.planner = staticmethod(_planner)
