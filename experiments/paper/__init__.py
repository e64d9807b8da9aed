"""Liu et al. by their own numbers: the printed example, the audit of the claims, and Section 5 simulated.

`counterexample` and `sets` look for steps that leave a set and confirm them in exact arithmetic; `kalman_filter` is the
filter of the paper, which the rest of this project does not use.
"""

from experiments.paper.audit import Claim, Verdict, audited_claims, defects
from experiments.paper.paper_example import PaperExample
from experiments.paper.reproduction import Outcome, Simulation, StateFeedback, designs, simulate

__all__ = [
    "Claim",
    "Outcome",
    "PaperExample",
    "Simulation",
    "StateFeedback",
    "Verdict",
    "audited_claims",
    "defects",
    "designs",
    "simulate",
]
