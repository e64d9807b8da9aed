"""Certificates of ellipsoids: of the largest one that a search finds, and of a given one with its gain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.network.contract import ChannelContract
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.synthesis.alternating_optimization import largest_set, with_best_gain
from shields.synthesis.certificate_fields import certificate_of
from shields.synthesis.design_problem import CandidateDesign, SymmetricLimits, design_problem
from shields.synthesis.invariant_polytope import feedback_of, limits_within_step
from shields.synthesis.search import Search
from shields.synthesis.tolerance import Tolerated
from shields.verification import Report, verify

# Relative tightening of the semidefinite programs, so that the result verifies exactly.
_SLACK = 1e-6
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


def largest_ellipsoid(
    plant: LinearPlant, contract: ChannelContract | None, gains: Sequence[Tolerated], search: Search
) -> Certificate | None:
    """Returns the largest set that alternation finds, verified; None where no set is found for no known reason.

    It begins at one of the gains. Where the set leaves the box between samples, one is sought in a box that is smaller
    by that.

    Raises:
        Infeasible: If the plant has no design problem, or there is no certificate for a known reason.
    """
    box_rows = plant.box_rows
    for _ in range(_MOST_BOXES):
        limits = SymmetricLimits(box_rows, plant.u_max)
        candidate = _candidate(plant, contract, limits, gains, search)
        over = None if candidate is None else _over_between_samples(candidate, plant)
        if over is None or over.max() <= 1.0:
            break
        box_rows = box_rows * over[:, None]
    else:
        candidate = None
    if candidate is not None:
        report = verify(candidate, plant)
        if report.valid:
            return candidate
        raise failed_verification(report)
    if (widest := float(np.abs(box_rows).max() / np.abs(plant.box_rows).max())) > 1.0:
        raise _leaves_between_samples(widest - 1.0)  # there is a set in the plant's own box
    if (spread := float(plant.half_widths.max() / plant.half_widths.min())) > _WIDEST_SPREAD:
        what = f"the plant is too ill-conditioned for this search, its half-widths differ by a factor of {spread:.0e}"
        raise Infeasible(f"{what}: {MORE_DIGITS}", "I", 1.0)
    return None


def _candidate(
    plant: LinearPlant,
    contract: ChannelContract | None,
    limits: SymmetricLimits,
    gains: Sequence[Tolerated],
    search: Search,
) -> Certificate | None:
    """Returns the certificate of the largest set within limits, not yet verified; None if no set is found."""
    search("error set")
    problem, errors = design_problem(plant, contract, limits)

    def certificate(design: CandidateDesign) -> Certificate:
        return certificate_of(plant, problem, with_best_gain(problem, design), errors)

    def report(stage: str, design: CandidateDesign) -> None:
        search.candidate = partial(certificate, design)
        search(f"{stage}: {math.exp(0.5 * design.log_det):.4f} of the box ellipsoid's volume")

    found = largest_set(problem, _SLACK, report, [each.K for each in gains])
    if found is None:
        return None
    report("exact verification", found)
    return certificate(found)


def _over_between_samples(certificate: Certificate, plant: LinearPlant) -> np.ndarray:
    """Returns by what factors a set leaves the box between samples, shape (k,), with some room; 1 where it does not.

    Raises:
        Infeasible: If no set stays inside.
    """
    grid = limits_within_step(feedback_of(certificate), plant)
    if not len(grid.high):
        return np.ones(len(plant.box_rows))
    if grid.high.min() <= 0.0:
        raise _leaves_between_samples(1.0)
    reach = np.sqrt(((grid.rows @ certificate.L) * grid.rows).sum(axis=1)) / grid.high
    over = reach.reshape(-1, len(plant.box_rows)).max(axis=0)
    left = over.max() > 1.0 - 0.1 * _BETWEEN_MARGIN
    return np.maximum(over / (1.0 - _BETWEEN_MARGIN), 1.0) if left else np.ones(len(over))


def _leaves_between_samples(shortfall: float) -> Infeasible:
    return Infeasible(
        "(B) the state leaves the box between two samples: a shorter dt, more grid points (between_samples=) or less "
        "disturbance would help, and between_samples=1 asks for the sampling instants alone",
        "B",
        shortfall,
    )


def failed_verification(report: Report) -> Infeasible:
    """Returns the exception for a candidate that does not verify."""
    failed = next(condition for condition in report.conditions if not condition.holds)
    return Infeasible(
        f"a candidate was found, but in exact arithmetic {failed.name} fails by {-failed.margin:.3g}: {MORE_DIGITS}",
        failed.name.split()[0].strip("():"),
        -failed.margin,
    )
