"""Certificates of ellipsoids: the largest invariant set that alternation finds (docs/shield_proof.md).

Linear matrix inequalities in set and gain alternate with the multipliers that suit both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.network.channel import ChannelContract
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.synthesis.certificate_fields import certificate_of
from shields.synthesis.design_problem import CandidateDesign, DesignProblem, design_problem
from shields.synthesis.invariant_set_program import (
    InvariantSetProgram,
    best_input_multipliers,
    best_multipliers,
    max_slack_gain,
    with_best_multipliers,
)
from shields.synthesis.tolerance import SUFFICIENT_MARGIN, Tolerated, invariant_ellipsoid
from shields.verification import Report, verify

if TYPE_CHECKING:
    from shields.synthesis.certification import Search

# Relative tightening of the semidefinite programs, so that the result verifies exactly.
_SLACK = 1e-6
# What helps where float64 has too few digits.
MORE_DIGITS = (
    "give states units in which the half-widths of the box are of similar size, and leave out rows of the box that are "
    "nearly the same as others"
)
# Where no set is found, half-widths of the box that differ by more are named as the reason.
_WIDEST_SPREAD = 1e6
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


def largest_ellipsoid(
    plant: LinearPlant, contract: ChannelContract | None, gains: Sequence[Tolerated], search: Search
) -> Certificate | None:
    """Returns the largest set that alternation finds, verified; None where no set is found for no known reason.

    It begins at one of the gains.

    Raises:
        Infeasible: If the plant has no design problem, or there is no certificate for a known reason.
    """
    candidate = _candidate(plant, contract, gains, search)
    if candidate is not None:
        report = verify(candidate, plant)
        if report.valid:
            return candidate
        raise failed_verification(report)
    if (spread := float(plant.half_widths.max() / plant.half_widths.min())) > _WIDEST_SPREAD:
        what = f"the plant is too ill-conditioned for this search, its half-widths differ by a factor of {spread:.0e}"
        raise Infeasible(f"{what}: {MORE_DIGITS}", "I", 1.0)
    return None


def _candidate(
    plant: LinearPlant,
    contract: ChannelContract | None,
    gains: Sequence[Tolerated],
    search: Search,
) -> Certificate | None:
    """Returns the certificate of the largest set, not yet verified; None if no gain bears the radii."""
    search("error set")
    problem, errors = design_problem(plant, contract)

    def certificate(design: CandidateDesign) -> Certificate:
        return certificate_of(plant, problem, _with_best_gain(problem, design), errors)

    def report(stage: str, design: CandidateDesign) -> None:
        search.candidate = partial(certificate, design)
        search(f"{stage}: {math.exp(0.5 * design.log_det):.4f} of the box ellipsoid's volume")

    program = InvariantSetProgram(problem, _SLACK)
    best = _initial_design(problem, program, [each.K for each in gains])
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
    report("exact verification", best)
    return certificate(best)


def failed_verification(report: Report) -> Infeasible:
    """Returns the exception for a candidate that does not verify."""
    failed = next(condition for condition in report.conditions if not condition.holds)
    return Infeasible(
        f"a candidate was found, but in exact arithmetic {failed.name} fails by {-failed.margin:.3g}: {MORE_DIGITS}",
        failed.name.split()[0].strip("():"),
        -failed.margin,
    )


def _initial_design(
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


def _with_best_gain(problem: DesignProblem, design: CandidateDesign) -> CandidateDesign:
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
