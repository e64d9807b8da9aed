"""Certificates of ellipsoids: of the largest one that a search finds, and of a given one with its gain."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ncs_gym import LinearPlant, exact
from ncs_gym.network.contract import ChannelContract
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.synthesis.alternating_optimization import ALTERNATIONS, largest_set, tightened, with_best_gain
from shields.synthesis.certificate_fields import certificate_of
from shields.synthesis.design_problem import CandidateDesign, DesignProblem, SymmetricLimits, design_problem
from shields.synthesis.invariant_polytope import feedback_of, limits_within_step
from shields.synthesis.max_margin_gain import max_margin_gain
from shields.synthesis.multipliers import best_input_multipliers, best_multipliers
from shields.synthesis.resting_point import at_operating_point
from shields.synthesis.search import Search
from shields.synthesis.tolerance import Tolerance, of_ellipsoid
from shields.verification import Report, verify

# Relative tightenings of the semidefinite programs, tried in turn until the result verifies exactly: the search takes
# the first, and what it found is tightened by the others.
SLACKS = (1e-6, 1e-5, 1e-4, 1e-3)
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


class FoundEllipsoid(NamedTuple):
    """What a search for the largest ellipsoid found.

    Attributes:
        problem: Its design problem.
        certificate: The verified certificate; None if there is none.
        K: The gain of the largest set, also of one that does not verify, shape (m, n); None where there is no set.
        failure: Why there is no certificate; None where no set was found for no known reason.
    """

    problem: DesignProblem
    certificate: Certificate | None
    K: np.ndarray | None
    failure: Infeasible | None


def largest_ellipsoid(
    plant: LinearPlant,
    contract: ChannelContract | None,
    search: Search,
    start: Certificate | None = None,
    alternations: int = ALTERNATIONS,
    tightened_boxes: tuple[np.ndarray, ...] = (),
) -> FoundEllipsoid:
    """Returns the largest set that alternation finds, verified.

    Args:
        plant: The plant.
        contract: Channel contract, if there is one.
        search: Is told the stages, and holds the best candidate.
        start: Certificate of a similar problem with as many states and inputs, which the search begins near.
        alternations: Largest number of them.
        tightened_boxes: The boxes that sets were sought in so far, rows (k, n), and one more; empty for the plant's
            own.

    Raises:
        Infeasible: If the plant has no design problem (`design_problem`).
    """
    search("error set")
    problem, errors = design_problem(plant, contract, _within(plant, tightened_boxes))
    near = None
    if start is not None and (shares := start.proofs[-1].shares) is not None:
        lx, le, ld = shares.tolist()
        near = _design_at(problem, start.L, start.K, (lx, le, ld))

    def report(stage: str, design: CandidateDesign | None) -> None:
        if design is not None:
            finished = partial(with_best_gain, problem, design)
            search.candidate = lambda: certificate_of(plant, problem, finished(), errors, SLACKS[0])
        search(progress_text(stage, design))

    found = largest_set(problem, SLACKS[0], report, near, alternations)
    if found is None:
        return FoundEllipsoid(problem, None, None, _known_reason(plant, tightened_boxes))
    failure, K = None, None
    for slack in SLACKS:
        design = found if slack == SLACKS[0] else tightened(problem, found, slack)
        if design is None:
            continue
        report("exact verification", design)
        certificate = certificate_of(plant, problem, with_best_gain(problem, design), errors, slack)
        K = certificate.K if K is None else K
        try:
            box_rows = _tightened_box(certificate, plant, tightened_boxes)
        except Infeasible as leaves:
            return FoundEllipsoid(problem, None, K, leaves)
        if box_rows is not None:
            boxes = (*tightened_boxes, box_rows)
            return largest_ellipsoid(plant, contract, search, start, alternations, boxes)
        verification = verify(certificate, plant)
        if verification.valid:
            return FoundEllipsoid(problem, certificate, K, None)
        failure = failure or _failed_verification(verification)
    return FoundEllipsoid(problem, None, K, failure)


def with_tolerated_scale(certificate: Certificate, plant: LinearPlant, problem: DesignProblem) -> Certificate:
    """Returns a certificate with a record of how much larger all radii could be for some set and gain.

    It is 1 at least, because this certificate exists: the search for a larger one is local, and covers the error sets
    of all ages by one. Of a polytope alone it is what its own gain bears.
    """
    scale = 1.0
    if certificate.keeps_ellipsoid:
        gain = max_margin_gain(problem, problem.covering_error_shape, searches=1)
        if gain is not None:
            scale = gain.margin if plant.grid_rows is None else of_ellipsoid(plant, problem, gain).margin
    else:
        tolerance = Tolerance(plant, certificate.error_shapes, certificate.D, at_operating_point(plant))
        if (found := tolerance.of(certificate.K)) is not None:
            scale = found.margin
    record = {"tolerated_scale": float(exact.rounded(max(scale, 1.0), 3))}
    return replace(certificate, provenance=certificate.provenance | record)


def _design_at(
    problem: DesignProblem, L: np.ndarray, K: np.ndarray, multipliers: tuple[float, float, float]
) -> CandidateDesign:
    """Returns a set and gain in physical units as a design, with the best multipliers near given ones."""
    scaled_L, scaled_K = problem.to_scaled(L, K)
    best, _ = best_multipliers(problem, problem.error_shapes, scaled_L, scaled_K, multipliers)
    inputs = best_input_multipliers(problem.error_shapes, scaled_L, scaled_K)
    return CandidateDesign(scaled_L, scaled_K, best, inputs, float(np.linalg.slogdet(scaled_L)[1]))


def _within(plant: LinearPlant, tightened_boxes: tuple[np.ndarray, ...]) -> SymmetricLimits:
    """Returns the limits within which a set is sought: the last of the boxes so far, or the plant's own."""
    return SymmetricLimits(tightened_boxes[-1] if tightened_boxes else plant.box_rows, plant.u_max)


def _tightened_box(
    certificate: Certificate, plant: LinearPlant, tightened_boxes: tuple[np.ndarray, ...]
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
    if len(tightened_boxes) == _MOST_BOXES or grid.high.min() <= 0.0:
        raise _leaves_between_samples(float(over.max() - 1.0))
    return (tightened_boxes[-1] if tightened_boxes else plant.box_rows) * np.maximum(
        over / (1.0 - _BETWEEN_MARGIN), 1.0
    )[:, None]


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


def _known_reason(plant: LinearPlant, tightened_boxes: tuple[np.ndarray, ...]) -> Infeasible | None:
    """Returns why no set was found, where that is known."""
    if tightened_boxes:  # there is a set in the plant's box
        widest = float(np.abs(tightened_boxes[-1]).max() / np.abs(plant.box_rows).max())
        return _leaves_between_samples(widest - 1.0)
    spread = float(plant.half_widths.max() / plant.half_widths.min())
    if spread <= _WIDEST_SPREAD:
        return None
    return Infeasible(
        f"the plant is too ill-conditioned for this search, its half-widths differ by a factor of {spread:.0e}: "
        f"{MORE_DIGITS}",
        "I",
        1.0,
    )


def _failed_verification(report: Report) -> Infeasible:
    """Returns the exception for a candidate that does not verify."""
    failed = next(condition for condition in report.conditions if not condition.holds)
    return Infeasible(
        f"a candidate was found, but in exact arithmetic {failed.name} fails by {-failed.margin:.3g}: {MORE_DIGITS}",
        failed.name.split()[0].strip("():"),
        -failed.margin,
    )
