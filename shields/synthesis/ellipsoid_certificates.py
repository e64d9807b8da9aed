"""Certificates of ellipsoids: of the largest one that a search finds, and of a given one with its gain."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ncs_gym import LinearPlant, exact
from ncs_gym.network.contract import ChannelContract
from shields.certificate import Certificate
from shields.certificate_text import size_of
from shields.errors import Infeasible, SynthesisInterrupted
from shields.synthesis.alternating_optimization import largest_set, with_best_gain
from shields.synthesis.certificate_fields import certificate_of
from shields.synthesis.design_problem import CandidateDesign, DesignProblem, SymmetricLimits, design_problem
from shields.synthesis.diagnosis import infeasibility
from shields.synthesis.invariant_polytope import feedback_of, limits_within_step
from shields.synthesis.max_margin_gain import max_margin_gain
from shields.synthesis.multipliers import best_input_multipliers, best_multipliers
from shields.synthesis.polytope_gain import ellipsoid_margin
from shields.verification import Report, verify

# Called with a line of text: the stage, and the volume reached so far.
Progress = Callable[[str], object]
# Relative tightenings of the semidefinite programs, tried in turn until the result verifies exactly.
SLACKS = (1e-6, 1e-5, 1e-4, 1e-3)
# In the details of an `Infeasible`: a candidate was found that does not hold in exact arithmetic.
LOST = "lost_in_exact_arithmetic"
# What helps where float64 has too few digits.
MORE_DIGITS = (
    "give states units in which the half-widths of the box are of similar size, and leave out rows of the box that are "
    "nearly the same as others"
)
# Where a set leaves the box between samples, one in a box that is smaller by what is missing and this is sought, so
# many times at most.
_BETWEEN_MARGIN, _MOST_BOXES = 1e-3, 8
# Where no set is found, half-widths of the box that differ by more are named as the reason.
_WIDEST_SPREAD = 1e6
# Multipliers from which those of a given set and gain are sought.
_INITIAL_MULTIPLIERS = (0.9, 0.03, 0.07)


def certify(
    plant: LinearPlant, L: np.ndarray, K: np.ndarray, contract: ChannelContract | None = None
) -> Certificate | None:
    """Returns a verified certificate for a given set and gain; None if no multipliers that prove it are found.

    Args:
        plant: The plant with its bounds.
        L: Shape of the safe set, (n, n).
        K: Gain, shape (m, n) [input per state].
        contract: Channel contract; with one, the error sets depend on the age of the newest sample.

    Raises:
        Infeasible: If the plant has no error set or its safe box is unbounded.
    """
    problem, errors = design_problem(plant, contract)
    design = _design_at(problem, L, K, _INITIAL_MULTIPLIERS)
    certificate = replace(certificate_of(plant, problem, design, errors, 0.0), L=L, K=K)
    return certificate if verify(certificate, plant).valid else None


def largest_ellipsoid(
    plant: LinearPlant, contract: ChannelContract | None, progress: Progress, tightened: tuple[np.ndarray, ...] = ()
) -> Certificate:
    """Returns the verified certificate of the largest set found.

    Args:
        plant: The plant.
        contract: Channel contract, if there is one.
        progress: Called with a line of text per stage.
        tightened: The boxes that sets were sought in so far, rows (k, n), and one more; empty for the plant's own.
    """
    progress("error set")
    problem, errors = design_problem(plant, contract, _within(plant, tightened))
    failure, slack = None, 0.0
    reached: tuple[str, CandidateDesign | None] = "start", None

    def report(stage: str, design: CandidateDesign | None) -> None:
        nonlocal reached
        reached = stage, design or reached[1]
        progress(progress_text(*reached))

    try:
        for slack in SLACKS:
            found = largest_set(problem, slack, report)
            if found is None:
                break
            design = with_best_gain(problem, found)
            report("exact verification", design)
            certificate = certificate_of(plant, problem, design, errors, slack)
            box_rows = _tightened_box(certificate, plant, tightened)
            if box_rows is not None:
                return largest_ellipsoid(plant, contract, progress, (*tightened, box_rows))
            verification = verify(certificate, plant)
            if verification.valid:
                return _with_tolerated_scale(certificate, problem)
            failure = _failed_verification(verification)
    except KeyboardInterrupt as interrupt:
        stage, design = reached
        best = design and certificate_of(plant, problem, with_best_gain(problem, design), errors, slack)
        raise _interrupted(plant, stage, best) from interrupt
    if tightened and not failure:  # there is a set in the plant's box
        raise _leaves_between_samples(float(np.abs(tightened[-1]).max() / np.abs(plant.box_rows).max() - 1.0))
    if not failure and (spread := float(plant.half_widths.max() / plant.half_widths.min())) > _WIDEST_SPREAD:
        failure = Infeasible(
            f"the plant is too ill-conditioned for this search, its half-widths differ by a factor of {spread:.0e}: "
            f"{MORE_DIGITS}",
            "I",
            1.0,
        )
    raise failure or infeasibility(plant, problem, polytope=False)


def nearby_ellipsoid(
    plant: LinearPlant,
    contract: ChannelContract | None,
    start: Certificate | None,
    alternations: int,
    progress: Progress,
    tightened: tuple[np.ndarray, ...] = (),
) -> Certificate | None:
    """Returns what `nearby_certificate` searches, in the boxes of `largest_ellipsoid`.

    Raises:
        Infeasible: If the plant has no error set, or the state leaves every box between two samples.
    """
    problem, errors = design_problem(plant, contract, _within(plant, tightened))
    near = None

    def report(stage: str, design: CandidateDesign | None) -> None:
        progress(progress_text(stage, design))

    if start is not None and (shares := start.proofs[-1].shares) is not None:
        lx, le, ld = shares.tolist()
        near = _design_at(problem, start.L, start.K, (lx, le, ld))
    for slack in SLACKS:
        found = largest_set(problem, slack, report, near, alternations)
        if found is None:
            return None
        certificate = certificate_of(plant, problem, with_best_gain(problem, found), errors, slack)
        box_rows = _tightened_box(certificate, plant, tightened)
        if box_rows is not None:
            return nearby_ellipsoid(plant, contract, start, alternations, progress, (*tightened, box_rows))
        if verify(certificate, plant).valid:
            return certificate
    return None


def _design_at(
    problem: DesignProblem, L: np.ndarray, K: np.ndarray, multipliers: tuple[float, float, float]
) -> CandidateDesign:
    """Returns a set and gain in physical units as a design, with the best multipliers near given ones."""
    scaled_L, scaled_K = problem.to_scaled(L, K)
    best, _ = best_multipliers(problem, problem.error_shapes, scaled_L, scaled_K, multipliers)
    inputs = best_input_multipliers(problem.error_shapes, scaled_L, scaled_K)
    return CandidateDesign(scaled_L, scaled_K, best, inputs, float(np.linalg.slogdet(scaled_L)[1]))


def _within(plant: LinearPlant, tightened: tuple[np.ndarray, ...]) -> SymmetricLimits:
    """Returns the limits within which a set is sought: the last of the boxes so far, or the plant's own."""
    return SymmetricLimits(tightened[-1] if tightened else plant.box_rows, plant.u_max)


def _tightened_box(
    certificate: Certificate, plant: LinearPlant, tightened: tuple[np.ndarray, ...]
) -> np.ndarray | None:
    """Returns rows of a smaller box, shape (k, n), if the set leaves the plant's between samples; None if it does not.

    Raises:
        Infeasible: If it still does after several boxes.
    """
    grid = limits_within_step(feedback_of(certificate), plant)
    if not len(grid.high):
        return None
    reach = np.sqrt(((grid.images @ certificate.L) * grid.images).sum(axis=1)) / np.maximum(grid.high, 1e-300)
    over = reach.reshape(-1, len(plant.box_rows)).max(axis=0)
    if over.max() <= 1.0 - 0.1 * _BETWEEN_MARGIN:
        return None
    if len(tightened) == _MOST_BOXES or grid.high.min() <= 0.0:
        raise _leaves_between_samples(float(over.max() - 1.0))
    return (tightened[-1] if tightened else plant.box_rows) * np.maximum(over / (1.0 - _BETWEEN_MARGIN), 1.0)[:, None]


def _leaves_between_samples(shortfall: float) -> Infeasible:
    """Returns the exception for sets that hold at the sampling instants alone."""
    return Infeasible(
        "(B) the state leaves the box between two samples: a shorter dt, more grid points (between_samples=) or less "
        "disturbance would help, and between_samples=1 asks for the sampling instants alone",
        "B",
        shortfall,
    )


def progress_text(stage: str, design: CandidateDesign | None) -> str:
    """Returns a line of progress."""
    volume = "no set yet" if design is None else f"{math.exp(0.5 * design.log_det):.4f} of the box ellipsoid's volume"
    return f"{stage}: {volume}"


def _interrupted(plant: LinearPlant, stage: str, best: Certificate | None) -> SynthesisInterrupted:
    """Returns the exception for an interrupted search, with the best certificate so far if it verifies."""
    message = f"interrupted: the synthesis was at {stage}"
    if best is None or not verify(best, plant).valid:
        return SynthesisInterrupted(f"{message} and had no certificate yet")
    size = size_of(best)
    best = replace(best, provenance=best.provenance | {"interrupted_at": stage})
    return SynthesisInterrupted(f"{message}, its best certificate has {size}", best)


def _with_tolerated_scale(certificate: Certificate, problem: DesignProblem) -> Certificate:
    """Returns the certificate with a record of how much larger all radii could be for some set and gain.

    It is 1 at least, because this certificate exists: the search for a larger one is local, and covers the error sets
    of all ages by one.
    """
    gain = max_margin_gain(problem, problem.covering_error_shape, searches=1)
    scale = 1.0 if gain is None else max(ellipsoid_margin(problem, gain), 1.0)
    return replace(certificate, provenance=certificate.provenance | {"tolerated_scale": float(exact.rounded(scale, 3))})


def _failed_verification(report: Report) -> Infeasible:
    """Returns the exception for a candidate that does not verify."""
    failed = next(condition for condition in report.conditions if not condition.holds)
    return Infeasible(
        f"a candidate was found, but in exact arithmetic {failed.name} fails by {-failed.margin:.3g}: {MORE_DIGITS}",
        failed.name.split()[0].strip("():"),
        -failed.margin,
        {LOST: -failed.margin},
    )
