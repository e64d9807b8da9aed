"""The printed numbers of Liu et al. Section 5: the example itself, its audit, and a reproduction of the simulation."""

from experiments.paper.audit import Claim, audited_claims
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
    "audited_claims",
    "designs",
    "simulate",
    "stays_inside",
    "worst_step",
]
