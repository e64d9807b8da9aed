"""Certificates of polytopes: for a certificate's own gain, a given one, or around a resting point that is sought."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ncs_gym import LinearPlant, exact
from ncs_gym.network.contract import ChannelContract
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.polytope import Polytope
from shields.synthesis.certificate_fields import (
    fields_of_problem,
    gain_in_digits,
    proofs_of,
    provenance_of,
    reach_recorded,
    shape_in_digits,
)
from shields.synthesis.design_problem import Rest, design_problem
from shields.synthesis.diagnosis import infeasibility
from shields.synthesis.ellipsoid_certificates import MORE_DIGITS, failed_verification
from shields.synthesis.invariant_polytope import (
    MARGINS,
    Feedback,
    Progress,
    feedback_of,
    invariant_polytope,
    points_of_box,
    share_in_polytope,
    share_of_points,
)
from shields.synthesis.resting_point import (
    disturbance_around,
    improved,
    limits_around,
    needs_resting_point,
)
from shields.synthesis.semidefinite_programs import largest_box_ellipsoid
from shields.synthesis.tolerance import Tolerated, most_tolerant
from shields.verification import verify

# The largest ellipsoid in a polytope is shrunk to this in its faces, more than its digits are rounded by; a thin one,
# of which rounding takes half of that, once more.
_INSIDE, _THIN_INSIDE = 1.0 - 1e-9, 1.0 - 1e-4
# Points of the box by which resting points are compared.
_POINTS_OF_REST_LOG2 = 12
# For so many gains a polytope is sought.
_MOST_SOUGHT = 4
# What ends the search for a polytope: a reason, or numbers that a linear program cannot hold.
_NOT_CERTIFIED = (ArithmeticError, ValueError)


def with_polytope(certificate: Certificate, plant: LinearPlant, progress: Progress = lambda line: None) -> Certificate:
    """Returns a verified certificate with the largest polytope that its gain keeps in the box.

    One that keeps a polytope alone is returned as it is. If none is found, the provenance, and so the printed
    certificate, says why.
    """
    if not certificate.keeps_ellipsoid:
        return certificate
    try:
        return _with_polytope_of(
            feedback_of(certificate), plant, lambda polytope: replace(certificate, polytope=polytope), progress
        )
    except _NOT_CERTIFIED as failure:
        reason = reason_of(failure)
    return replace(certificate, provenance=certificate.provenance | {"no_polytope": reason})


def reason_of(failure: Exception) -> str:
    """Returns why there is no certificate; what a library says of numbers stands in parentheses."""
    if isinstance(failure, Infeasible):
        return str(failure)
    return f"its numbers are out of reach of float64 ({failure}): {MORE_DIGITS}"


def certified_polytope(
    plant: LinearPlant,
    K: np.ndarray,
    contract: ChannelContract | None,
    rest: Rest,
    progress: Progress = lambda line: None,
) -> Certificate:
    """Returns a verified certificate with the largest polytope that a given gain keeps in the box.

    The polytope alone is claimed to be invariant; L is that of the largest ellipsoid inside it, and inside generous
    limits where states have none. The gain K is of shape (m, n) [input per state].

    Raises:
        ArithmeticError, ValueError: If there is none; the message says why.
    """
    limits = limits_around(plant, rest)
    problem, errors = design_problem(plant, contract, limits)
    K, proofs = gain_in_digits(K, plant), proofs_of(errors)
    feedback = Feedback(K, np.array([proof.Sigma for proof in proofs]), disturbance_around(plant, rest), rest)
    others: dict[str, Any] = fields_of_problem(plant, problem, errors) | {"D": feedback.D}
    others |= {"K": K, "proofs": proofs, "resting_state": rest.state, "resting_input": rest.input}

    def certificate(polytope: Polytope) -> Certificate:
        faces = polytope.F
        inside = polytope.rows if polytope.is_symmetric else faces
        if exact.rank(plant.box) < plant.n:  # a polytope may have no end, or a very far one, where a state has no limit
            inside = np.concatenate([inside, limits.box_rows])
        L = largest_box_ellipsoid(inside)
        L = shape_in_digits(L * (_INSIDE / _reach(faces, L)))
        L = L if _reach(faces, L) < 0.5 * (1.0 + _INSIDE) else shape_in_digits(_THIN_INSIDE * L)
        return Certificate(L=L, polytope=polytope, provenance=provenance_of(plant, L), **others)

    return _with_polytope_of(feedback, plant, certificate, progress)


def _reach(faces: np.ndarray, L: np.ndarray) -> float:
    """Returns the largest f L f' of faces, shape (q, n): E(L) lies between them if it is at most 1."""
    return float(((faces @ L) * faces).sum(axis=1).max())


def _with_polytope_of(
    feedback: Feedback,
    plant: LinearPlant,
    certificate_with: Callable[[Polytope], Certificate],
    progress: Progress,
) -> Certificate:
    """Returns a verified certificate with the polytope of a fallback, sought with one margin after the other.

    Raises:
        ArithmeticError, ValueError: If there is none; the message says why the first is.
    """
    failure: Exception | None = None
    for margin in MARGINS:
        try:
            polytope = invariant_polytope(feedback, plant, margin, progress)
        except _NOT_CERTIFIED as none:
            failure = failure or none
            progress(f"polytope: {none}")
            if isinstance(none, Infeasible) and none.binding != "R" and margin == min(MARGINS):
                break  # a larger margin leaves less
            continue
        try:
            return _verified_polytope(certificate_with(polytope), plant)
        except _NOT_CERTIFIED as none:
            failure = failure or none
    assert failure is not None
    raise failure


def around_resting_point(
    plant: LinearPlant, contract: ChannelContract | None, gains: Sequence[Tolerated], progress: Progress
) -> Certificate:
    """Returns a verified certificate of a polytope alone, around a resting point.

    One polytope is sought for each of the `_MOST_SOUGHT` first gains that bear the radii, and for the most tolerant.

    Raises:
        Infeasible: If there is none: why the polytope of the first gain was given up.
    """
    tried = _by_share([each for each in gains if each.margin >= 1.0], plant, contract, progress)
    best, reasons = most_tolerant(gains), list[str]()
    for each in [*tried[:_MOST_SOUGHT], *(each for each in tried[_MOST_SOUGHT:] if each is best)]:
        try:
            return certified_polytope(plant, each.K, contract, each.rest, progress)
        except _NOT_CERTIFIED as failure:
            reasons.append(reason_of(failure))
    raise infeasibility(plant, best, polytope=True, reason=reasons[0] if reasons else "")


def _by_share(
    gains: Sequence[Tolerated], plant: LinearPlant, contract: ChannelContract | None, progress: Progress
) -> list[Tolerated]:
    """Returns gains that differ in a certificate's digits, those that keep the most of the box first.

    Where a share of the box is known, the first one is of a better resting point.
    """
    keys = [(gain_in_digits(each.K, plant).tobytes(), each.rest.state.tobytes()) for each in gains]
    gains = [each for number, each in enumerate(gains) if keys[number] not in keys[:number]]
    points = points_of_box(plant, _POINTS_OF_REST_LOG2)
    if points is None or not gains:
        return list(gains)
    errors = design_problem(plant, contract, limits_around(plant, gains[0].rest))[1].promised

    def share(K: np.ndarray, rest: Rest) -> float:
        return share_of_points(Feedback(K, errors, disturbance_around(plant, rest), rest), plant, points)

    shares = np.array([share(each.K, each.rest) for each in gains])
    gains = [gains[k] for k in np.argsort(-shares, kind="stable")]
    if needs_resting_point(plant):
        progress(f"resting point: {100.0 * shares.max():.1f} % of the box")
        better = improved(plant, gains[0].rest, lambda rest: share(gains[0].K, rest))
        gains = [gains[0]._replace(rest=better), *gains] if better is not gains[0].rest else gains
    return gains


def _verified_polytope(certificate: Certificate, plant: LinearPlant) -> Certificate:
    """Returns a certificate with a polytope, verified, with the polytope's size.

    Raises:
        Infeasible: If it does not verify.
    """
    assert certificate.polytope is not None
    report = verify(certificate, plant)
    if not report.valid:
        raise failed_verification(report)
    others = {name: value for name, value in certificate.provenance.items() if name != "reach"}
    if (share := share_in_polytope(certificate.polytope, plant)) is None:
        return replace(certificate, provenance=others | reach_recorded(certificate.polytope, plant))
    return replace(certificate, provenance=others | {"polytope_share_of_box": float(exact.rounded(share, 3))})
