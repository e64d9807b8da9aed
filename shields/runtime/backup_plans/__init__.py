"""Backup plans, mode "lookahead": inputs that keep the state in the box until it is in the safe set.

`plan_check` decides which plans are certified, `plan_search` proposes them, with candidates and with a solver, which
proves nothing, and `stored_plans` is the rule of the mode: which plan is applied and what is stored of it. Importing
this package imports the solver.
"""

from shields.runtime.backup_plans.plan_check import PlanTest, Prediction
from shields.runtime.backup_plans.stored_plans import Lookahead

__all__ = ["Lookahead", "PlanTest", "Prediction"]
