"""Certificates of polytopes: for a certificate's own gain, a given one, or around a resting point that is sought."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ncs_gym import LinearPlant, exact
from ncs_gym.network.channel import ChannelContract
from shields.certificate import Certificate, Proof
from shields.errors import Infeasible
from shields.polytope import Polytope
from shields.synthesis.certificate_fields import (
    fields_of_plant,
    gain_in_digits,
    proofs_of,
    reach_recorded,
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
from shields.synthesis.tolerance import Tolerated, most_tolerant
from shields.verification import verify

# Points of the box by which resting points are compared.
_POINTS_OF_REST_LOG2 = 12
# For so many gains a polytope is sought.
_MOST_SOUGHT = 4
# What is recorded of an ellipsoid's size.
_SIZES = ("share_of_box", "share_of_box_at_rest", "volume_of_box_ellipsoid", "reach")
# What ends the search for a polytope: a reason, or numbers that a linear program cannot hold.
_NOT_CERTIFIED = (ArithmeticError, ValueError)


def with_polytope(certificate: Certificate, plant: LinearPlant, progress: Progress = lambda line: None) -> Certificate:
    """Returns a verified certificate of the largest polytope that the gain of an ellipsoid keeps in the box.

    If none is found, it is that of the ellipsoid, whose provenance, and so the printed certificate, says why.
    """
    if isinstance(certificate.safe_set, Polytope):
        return certificate
    kept = {name: value for name, value in certificate.provenance.items() if name not in _SIZES}
    proofs = [Proof(Sigma=each.Sigma, rate=each.rate) for each in certificate.proofs]
    rows_alone = partial(replace, certificate, proofs=proofs, rounding=None, provenance=kept)
    try:
        return _with_polytope_of(feedback_of(certificate), plant, rows_alone, progress)
    except _NOT_CERTIFIED as failure:
        return certificate.recording({"no_polytope": reason_of(failure)})


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

    The gain K is of shape (m, n) [input per state].

    Raises:
        ArithmeticError, ValueError: If there is none; the message says why.
    """
    errors = design_problem(plant, contract, limits_around(plant, rest))[1]
    K, proofs = gain_in_digits(K, plant), proofs_of(errors)
    feedback = Feedback(K, np.array([proof.Sigma for proof in proofs]), disturbance_around(plant, rest), rest)
    certificate = partial(
        Certificate,
        K=K,
        proofs=proofs,
        D=feedback.D,
        resting_state=rest.state,
        resting_input=rest.input,
        **fields_of_plant(plant, errors),
    )
    return _with_polytope_of(feedback, plant, certificate, progress)


def _with_polytope_of(
    feedback: Feedback,
    plant: LinearPlant,
    certificate: Callable[..., Certificate],
    progress: Progress,
) -> Certificate:
    """Returns a verified certificate, made with `safe_set`, of a fallback's polytope, sought with several margins.

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
            continue
        try:
            return _verified_polytope(certificate(safe_set=polytope), polytope, plant)
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


def _verified_polytope(certificate: Certificate, polytope: Polytope, plant: LinearPlant) -> Certificate:
    """Returns the certificate of a polytope, verified, with its size.

    Raises:
        Infeasible: If it does not verify.
    """
    report = verify(certificate, plant)
    if not report.valid:
        raise failed_verification(report)
    share = share_in_polytope(polytope, plant)
    if share is None:
        return certificate.recording(reach_recorded(polytope, plant))
    return certificate.recording({"share_of_box": float(exact.rounded(share, 3))})
