"""Initial designs for the alternation, which stalls if it begins at a poor one (docs/shield_proof.md)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from shields.synthesis.design_problem import CandidateDesign, DesignProblem
from shields.synthesis.invariant_set_program import InvariantSetProgram
from shields.synthesis.max_margin_gain import MaxMarginGain, max_margin_gain
from shields.synthesis.multipliers import best_input_multipliers

# The multiplier lx and the fraction le / (1 - lx) of the initial designs.
_INITIAL_MULTIPLIERS = ((0.85, 0.3), (0.85, 0.1), (0.92, 0.3), (0.92, 0.1), (0.75, 0.3), (0.6, 0.2), (0.97, 0.2))
_INITIAL_INPUT_MULTIPLIER = 0.8
# The invariant set of the max-margin gain is enlarged by at most this factor before X is linearized there.
_LARGEST_ENLARGEMENT = 100.0
# Exact verification needs a margin a little above 1.
SUFFICIENT_MARGIN = 1.0 + 1e-5
# A design whose log det is within this of the box ellipsoid's cannot be improved noticeably.
VOLUME_TOLERANCE = 2e-4

# Called with the stage that the search is in, and the design of the largest set so far.
ProgressCallback = Callable[[str, CandidateDesign | None], None]


def initial_design(
    problem: DesignProblem, program: InvariantSetProgram, report: ProgressCallback
) -> CandidateDesign | None:
    """Returns a feasible design, from fixed multipliers if possible and else from a gain; None if none is found."""
    design = _from_fixed_multipliers(problem, program, report) if len(problem.error_shapes) == 1 else None
    return design or _from_max_margin_gain(problem, program, report)


def multiplier_triple(lx: float, error_fraction: float) -> tuple[float, float, float]:
    """Returns (lx, le, ld) with sum 1, given lx and the fraction le / (1 - lx)."""
    return float(lx), float((1.0 - lx) * error_fraction), float((1.0 - lx) * (1.0 - error_fraction))


def _from_fixed_multipliers(
    problem: DesignProblem, program: InvariantSetProgram, report: ProgressCallback
) -> CandidateDesign | None:
    """Returns the best design over a few multipliers and two linearizations."""
    Sigma = problem.error_shapes[-1]
    normalized = Sigma / float(np.linalg.eigvalsh(Sigma)[-1])
    inputs = np.full(problem.m, _INITIAL_INPUT_MULTIPLIER)
    best = None
    trials = list(product(_INITIAL_MULTIPLIERS, (np.eye(problem.n), normalized)))
    for trial, ((lx, error_fraction), linearize_at) in enumerate(trials):
        design = program.solve(multiplier_triple(lx, error_fraction), inputs, linearize_at)
        if design is not None and (best is None or design.log_det > best.log_det):
            best = design
        report(f"initial design {trial + 1} of {len(trials)}", best)
        if best is not None and -best.log_det < VOLUME_TOLERANCE:
            break
    return best


def _from_max_margin_gain(
    problem: DesignProblem, program: InvariantSetProgram, report: ProgressCallback
) -> CandidateDesign | None:
    """Returns a design near the gain of largest margin; None if that margin is below 1."""
    several = len(problem.error_shapes) > 1
    gain = None
    for Sigma in (problem.error_shapes[-1], problem.covering_error_shape) if several else problem.error_shapes:
        report("search for the gain of largest margin", None)
        gain = max_margin_gain(problem, Sigma)
        if gain is None or gain.margin < SUFFICIENT_MARGIN:
            continue
        L = min(gain.margin**2, _LARGEST_ENLARGEMENT) * gain.L
        design = program.solve(gain.multipliers, best_input_multipliers(Sigma[None], L, gain.K), L)
        if design is not None:
            return design
    # The program thickens error sets by age and may be infeasible for that reason alone; the gain's own set is not.
    if several and gain is not None and gain.margin >= SUFFICIENT_MARGIN:
        return _as_design(gain, problem.covering_error_shape)
    return None


def _as_design(gain: MaxMarginGain, Sigma: np.ndarray) -> CandidateDesign:
    """Returns the gain's invariant set as a design, enlarged so that (I) and the limits have equal slack."""
    L = gain.margin * gain.L
    inputs = best_input_multipliers(Sigma[None], L, gain.K)
    return CandidateDesign(L, gain.K, gain.multipliers, inputs, float(np.linalg.slogdet(L)[1]))
