"""Lookahead: inputs after which a certified backup plan keeps the state in the box until it is in the safe set.

`prediction` says what a plant does within N steps, `tightening` how far errors and disturbances reach around that,
`plan_test` which plans keep every possible state in the box and end in S, `candidates` proposes plans at no cost and
`program` finds them with a solver, which proves nothing. `planner` searches, and `decision` is the rule of mode
"lookahead". Arrays count environments on their first axis here. Importing this package imports the solver.
"""

from shields.lookahead.decision import Lookahead
from shields.lookahead.plan_test import PlanTest
from shields.lookahead.planner import Planner, Plans
from shields.lookahead.prediction import Prediction

__all__ = ["Lookahead", "PlanTest", "Planner", "Plans", "Prediction"]
