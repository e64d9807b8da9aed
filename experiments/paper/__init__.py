"""The printed numbers of Liu et al. Section 5: the example itself, its audit, and a reproduction of the simulation."""

from experiments.paper.audit import Claim, Verdict, audited_claims, defects
from experiments.paper.counterexample import OneStep, stays_inside, worst_step
from experiments.paper.paper_example import PaperExample
from experiments.paper.reproduction import Outcome, Simulation, StateFeedback, designs, simulate

__all__ = [
    "Claim",
    "OneStep",
    "Outcome",
    "PaperExample",
    "Simulation",
    "StateFeedback",
    "Verdict",
    "audited_claims",
    "defects",
    "designs",
    "simulate",
    "stays_inside",
    "worst_step",
]
