"""The shield at run time: which inputs keep the next state safe, what is applied instead, and what is proved.

`set_test` decides whether an input passes, `projection` finds the closest one that does, `backup_plans` the plans of
mode "lookahead", and `safety_filter` makes the decision (`decisions`: what it says).
`guarantee` follows whether the proof of safety holds, from what `starts` knows of the first states, and says where it
ends. `guard` is filter and guarantee of one loop, or of N, the last axis of all arrays; `safe_loop` puts it into a real
loop, `wrapper` into environments.
"""

from shields.runtime.decisions import Decision
from shields.runtime.guarantee import GuaranteeMonitor, MonitorState
from shields.runtime.safe_loop import SafeLoop
from shields.runtime.safety_filter import SafetyFilter
from shields.runtime.wrapper import SafetyShield, VectorSafetyShield

__all__ = [
    "Decision",
    "GuaranteeMonitor",
    "MonitorState",
    "SafeLoop",
    "SafetyFilter",
    "SafetyShield",
    "VectorSafetyShield",
]
