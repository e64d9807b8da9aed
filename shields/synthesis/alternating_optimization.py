"""The largest invariant set: linear matrix inequalities and multipliers alternate (docs/shield_proof.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from shields.synthesis.design_problem import CandidateDesign, DesignProblem
from shields.synthesis.invariant_set_program import InvariantSetProgram, max_slack_gain
from shields.synthesis.multipliers import best_input_multipliers, best_multipliers, with_best_multipliers
from shields.synthesis.tolerance import SUFFICIENT_MARGIN, invariant_ellipsoid

# Some plants still gain 1 % of volume per alternation after ten of them.
_ALTERNATIONS = 40
# An alternation that gains less than this in log det, 1 % of volume, is the last one with its step.
_SMALLEST_GAIN = 0.02
# Relative steps of the pattern search over the multipliers.
_STEPS = (0.3, 0.1, 0.033)
# The invariant set of a gain is enlarged by at most this factor before X is linearized there.
_LARGEST_ENLARGEMENT = 100.0
# A design whose log det is within this of the box ellipsoid's cannot be improved noticeably.
_VOLUME_TOLERANCE = 2e-4

# Called with the stage that the search is in, and the design of the largest set so far.
ProgressCallback = Callable[[str, CandidateDesign], None]


def largest_set(
    problem: DesignProblem,
    slack: float,
    report: ProgressCallback,
    gains: Sequence[np.ndarray],
) -> CandidateDesign | None:
    """Returns the design of largest volume that alternation finds; None if no initial design is found.

    Args:
        problem: The scaled design problem.
        slack: Relative tightening of the conditions.
        report: Called with the stage and the best design so far.
        gains: Gains in physical units, shape (m, n), of which one has the initial design.
    """
    program = InvariantSetProgram(problem, slack)
    best = initial_design(problem, program, gains)
    if best is None:
        return None
    report("initial design", best)
    steps = list(_STEPS)
    for turn in range(_ALTERNATIONS):
        if -best.log_det < _VOLUME_TOLERANCE or not steps:
            break
        better = _alternate(problem, program, best, steps[0])
        report(f"alternation {turn + 1} of at most {_ALTERNATIONS}", better)
        if better.log_det - best.log_det < _SMALLEST_GAIN:
            steps.pop(0)
        best = better
    return best


def initial_design(
    problem: DesignProblem, program: InvariantSetProgram, gains: Sequence[np.ndarray]
) -> CandidateDesign | None:
    """Returns a feasible design near the gain whose invariant ellipsoid bears most; None if none bears the radii.

    The program thickens error sets by age and may be infeasible for that reason alone; the gain's own set is not. It is
    then enlarged so that (I) and the limits have equal slack.
    """
    ellipsoids = [invariant_ellipsoid(problem, K) for K in gains]
    best = max(filter(None, ellipsoids), key=lambda each: each.margin, default=None)
    if best is None or best.margin < SUFFICIENT_MARGIN:
        return None
    Sigma = problem.covering_error_shape[None]
    L = min(best.margin**2, _LARGEST_ENLARGEMENT) * best.L
    design = program.solve(best.multipliers, best_input_multipliers(Sigma, L, best.K), L)
    if design is None and len(problem.error_shapes) > 1:
        L = best.margin * best.L
        design = CandidateDesign(L, best.K, best.multipliers, best_input_multipliers(Sigma, L, best.K))
    return design


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
        shifted_lx = float(1.0 - np.clip((1.0 - lx) * factor, 1e-4, 0.99))
        shifted_fraction = float(np.clip(error_fraction * (1.0 + shift), 1e-3, 0.99))
        shifted = shifted_lx, (1.0 - shifted_lx) * shifted_fraction, (1.0 - shifted_lx) * (1.0 - shifted_fraction)
        best = _larger(best, program.solve(shifted, best.inputs, best.L))
    return best


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
    return other if other is not None and other.log_det > best.log_det else best
