"""The shield at run time: which inputs keep the next state safe, what is applied instead, and what is proved.

`predicted_errors` and `one_step_test` decide whether an input passes, `projection` finds the closest one that does,
`filter` makes the decision, `guarantee` follows whether the proof of safety holds, and `wrapper` and `vector_wrapper`
put all of it around Gymnasium environments. Everything is written for arrays whose last axis counts environments.
"""

from shields.runtime.filter import Decision, SafetyFilter
from shields.runtime.guarantee import GuaranteeMonitor, MonitorState
from shields.runtime.vector_wrapper import VectorSafetyShield
from shields.runtime.wrapper import SafetyShield

__all__ = ["Decision", "GuaranteeMonitor", "MonitorState", "SafetyFilter", "SafetyShield", "VectorSafetyShield"]
