"""The largest invariant set: linear matrix inequalities and multipliers alternate (docs/shield_proof.md)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shields.synthesis.design_problem import CandidateDesign, DesignProblem
from shields.synthesis.initial_designs import (
    VOLUME_TOLERANCE,
    ProgressCallback,
    initial_design,
    multiplier_triple,
)
from shields.synthesis.invariant_set_program import InvariantSetProgram, max_slack_gain
from shields.synthesis.multipliers import best_input_multipliers, best_multipliers, with_best_multipliers

# Some plants still gain 1 % of volume per alternation after ten of them.
ALTERNATIONS = 40
# An alternation that gains less than this in log det, 1 % of volume, is the last one with its step.
_SMALLEST_GAIN = 0.02
# Relative steps of the pattern search over the multipliers.
_STEPS = (0.3, 0.1, 0.033)


def largest_set(
    problem: DesignProblem,
    slack: float,
    report: ProgressCallback,
    start: CandidateDesign | None = None,
    alternations: int = ALTERNATIONS,
) -> CandidateDesign | None:
    """Returns the design of largest volume that alternation finds; None if no initial design is found.

    Args:
        problem: The scaled design problem.
        slack: Relative tightening of the conditions.
        report: Called with the stage and the best design so far, per initial design and per alternation.
        start: Design of a similar problem, which alternation begins near if it can; None for none.
        alternations: Largest number of them.
    """
    program = InvariantSetProgram(problem, slack)
    best = None if start is None else program.solve(start.multipliers, start.inputs, start.L)
    best = best or initial_design(problem, program, report)
    if best is None:
        return None
    steps = list(_STEPS)
    for turn in range(alternations):
        if -best.log_det < VOLUME_TOLERANCE or not steps:
            break
        better = _alternate(problem, program, best, steps[0])
        report(f"alternation {turn + 1} of at most {alternations}", better)
        if better.log_det - best.log_det < _SMALLEST_GAIN:
            steps.pop(0)
        best = better
    return best


def _alternate(
    problem: DesignProblem, program: InvariantSetProgram, best: CandidateDesign, step: float
) -> CandidateDesign:
    """Returns the best design with X linearized at the best L so far, over several multipliers; never a worse one.

    The multipliers are the design's own, those that suit its set and gain best, and a pattern around them.
    """
    tuned = with_best_multipliers(problem, best, problem.error_shapes)
    linearize_at = best.L
    for multipliers, inputs in ((best.multipliers, best.inputs), (tuned.multipliers, tuned.inputs)):
        best = _larger(best, program.solve(multipliers, inputs, linearize_at))
    lx, le, _ = best.multipliers
    error_fraction = le / (1.0 - lx)
    for factor, shift in ((1.0 + step, 0.0), (1.0 / (1.0 + step), 0.0), (1.0, step), (1.0, -step)):
        shifted_lx = 1.0 - np.clip((1.0 - lx) * factor, 1e-4, 0.99)
        shifted_fraction = np.clip(error_fraction * (1.0 + shift), 1e-3, 0.99)
        best = _larger(best, program.solve(multiplier_triple(shifted_lx, shifted_fraction), best.inputs, best.L))
    return best


def tightened(problem: DesignProblem, design: CandidateDesign, slack: float) -> CandidateDesign | None:
    """Returns the largest set next to a design, with its multipliers, for a larger slack; None if there is none."""
    return InvariantSetProgram(problem, slack).solve(design.multipliers, design.inputs, design.L)


def with_best_gain(problem: DesignProblem, design: CandidateDesign) -> CandidateDesign:
    """Returns the design with L kept, and the gain and multipliers that leave the conditions the largest slack."""
    finished = []
    for K in (max_slack_gain(problem, design), design.K):
        multipliers, largest_eigenvalue = best_multipliers(
            problem, problem.error_shapes, design.L, K, design.multipliers
        )
        inputs = best_input_multipliers(problem.error_shapes, design.L, K)
        error_input = np.sqrt(((K @ problem.error_shapes) * K).sum(axis=-1)).max(axis=0)
        largest_input = (np.sqrt(((K @ design.L) * K).sum(axis=1)) + error_input).max()
        candidate = replace(design, K=K, multipliers=multipliers, inputs=inputs)
        finished.append((max(largest_eigenvalue, largest_input), candidate))
    return min(finished, key=lambda pair: pair[0])[1]


def _larger(best: CandidateDesign, other: CandidateDesign | None) -> CandidateDesign:
    """Returns the design with the larger set."""
    return other if other is not None and other.log_det > best.log_det else best
