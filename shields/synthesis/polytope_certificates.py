"""Certificates of polytopes: for a certificate's own gain, a given one, or around a resting point that is sought."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from ncs_gym import ErrorSet, LinearPlant, exact
from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.hard_bounds import inflated
from ncs_gym.uncertainty.shape_matrices import outer_sum
from shields.certificate import Certificate
from shields.errors import CertificateError, Infeasible
from shields.synthesis.alternating_optimization import largest_set, with_best_gain
from shields.synthesis.certificate_fields import (
    fields_of_problem,
    gain_in_digits,
    proofs_of,
    provenance_of,
    reach_recorded,
    shape_in_digits,
    volume_of,
)
from shields.synthesis.design_problem import CandidateDesign, DesignProblem, Rest, design_problem
from shields.synthesis.ellipsoid_certificates import MORE_DIGITS, SLACKS, progress_text
from shields.synthesis.invariant_polytope import (
    Feedback,
    feedback_of,
    invariant_polytope,
    points_of_box,
    share_in_polytope,
    share_of_last_input,
    share_of_points,
)
from shields.synthesis.max_margin_gain import max_margin_gain
from shields.synthesis.polytope_gain import (
    HOPELESS,
    more_tolerant_gain,
    most_tolerant_gain,
    needs_of,
    regulators,
)
from shields.synthesis.resting_point import (
    Farthest,
    at_operating_point,
    distances,
    farthest_equilibrium,
    farthest_from_limits,
    improved,
    limits_around,
)
from shields.synthesis.search import Progress
from shields.synthesis.semidefinite_programs import largest_box_ellipsoid
from shields.verification import verify

# The largest ellipsoid in a polytope is shrunk to this in its faces, more than its digits are rounded by.
_INSIDE = 1.0 - 1e-9
# Points of the box by which resting points are compared.
_POINTS_OF_REST_LOG2 = 12
# For so many gains a polytope is sought.
_MOST_SOUGHT = 4
# What an equilibrium lacks is computed with an error of at most this, relative to its terms.
_OF_REST = 1e-14
# What ends the search for a polytope: a reason, or numbers that a linear program cannot hold.
_NOT_CERTIFIED = (Infeasible, ArithmeticError, ValueError, CertificateError)


def with_polytope(certificate: Certificate, plant: LinearPlant, progress: Progress = lambda line: None) -> Certificate:
    """Returns a verified certificate with the largest polytope that its gain keeps in the box.

    One that keeps a polytope alone is returned as it is. Without a polytope if none is found; its provenance, and so
    the printed certificate, says why.

    Args:
        certificate: A verified one.
        plant: Its plant.
        progress: Called with a line of text now and then.
    """
    if not certificate.keeps_ellipsoid:
        return certificate
    try:
        polytope = invariant_polytope(feedback_of(certificate), plant, progress)
        return _verified_polytope(replace(certificate, polytope=polytope), plant, progress)
    except _NOT_CERTIFIED as failure:
        reason = _reason_of(failure)
    return replace(certificate, provenance=certificate.provenance | {"no_polytope": reason})


def _reason_of(failure: Exception) -> str:
    """Returns why there is no polytope; what a library says of numbers stands in parentheses."""
    if isinstance(failure, Infeasible):
        return str(failure)
    return f"its numbers are out of reach of float64 ({failure}): {MORE_DIGITS}"


def certify_polytope(
    plant: LinearPlant,
    K: np.ndarray,
    contract: ChannelContract | None = None,
    progress: Progress = lambda line: None,
    rest: Rest | None = None,
) -> Certificate | None:
    """Returns a verified certificate with the largest polytope that a given gain keeps in the box; None for none.

    The polytope alone is claimed to be invariant; L is that of the largest ellipsoid inside it, and inside generous
    limits where states have none.

    Args:
        plant: The plant with its bounds.
        K: Gain, shape (m, n) [input per state].
        contract: Channel contract; with one, the error sets depend on the age of the newest sample.
        progress: Called with a line of text now and then.
        rest: The point around which it is sought; the operating point by default.

    Raises:
        Infeasible: If the plant has no error set or its safe box is unbounded.
    """
    try:
        rest = at_operating_point(plant) if rest is None else rest
        return _certified_polytope(plant, K, contract, progress, rest)
    except _NOT_CERTIFIED as failure:
        if isinstance(failure, Infeasible) and failure.binding != "P":
            raise
        return None


def _certified_polytope(
    plant: LinearPlant,
    K: np.ndarray,
    contract: ChannelContract | None,
    progress: Progress,
    rest: Rest,
) -> Certificate:
    """Returns what `certify_polytope` does.

    Raises:
        Infeasible, ArithmeticError, ValueError, CertificateError: If there is none; the message says why.
    """
    limits = limits_around(plant, rest)
    problem, errors = design_problem(plant, contract, limits)
    K, proofs = gain_in_digits(K, plant), proofs_of(errors)
    feedback = Feedback(K, np.array([proof.Sigma for proof in proofs]), _disturbance_around(plant, rest), rest)
    polytope = invariant_polytope(feedback, plant, progress)
    faces = polytope.F
    inside = polytope.rows if polytope.is_symmetric else faces
    if exact.rank(plant.box) < plant.n:  # a polytope may have no end, or a very far one, where a state has no limit
        inside = np.concatenate([inside, limits.box_rows])
    L = largest_box_ellipsoid(inside)
    L = shape_in_digits(L * (_INSIDE / ((faces @ L) * faces).sum(axis=1).max()))
    others: dict[str, Any] = fields_of_problem(plant, problem, errors) | {"D": feedback.D}
    others |= {"resting_state": rest.state, "resting_input": rest.input}
    provenance = provenance_of(plant, L, volume_of(plant, L))
    certificate = Certificate(L=L, K=K, proofs=proofs, polytope=polytope, provenance=provenance, **others)
    return _verified_polytope(certificate, plant, progress)


def around_resting_point(
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Progress,
    fixed: Rest | None = None,
    known: Sequence[np.ndarray] | None = None,
) -> Certificate:
    """Returns a verified certificate of a polytope alone, around a resting point.

    The gain is sought within symmetric limits around the equilibrium that is farthest from all limits, or around a
    fixed one; where the share of the box is known, a better resting point then. One polytope is sought for each of the
    `_MOST_SOUGHT` first gains, then for one that tolerates more than they do.

    Args:
        plant: The plant.
        contract: Channel contract; None for none.
        progress: Called with a line of text now and then.
        fixed: The resting point; the one that suits each gain by default.
        known: As in `fallbacks_around`.

    Raises:
        Infeasible: If none is found; the message says why the first gain was given up.
    """
    progress("resting point")
    reasons: list[str] = []
    fallbacks = _different(fallbacks_around(plant, contract, progress, fixed, known), plant)
    for each in chain(fallbacks[:_MOST_SOUGHT], more_tolerant(fallbacks, plant, progress, fixed)):
        try:
            return _certified_polytope(plant, each.K, contract, progress, each.rest)
        except _NOT_CERTIFIED as failure:
            reasons.append(_reason_of(failure))
    raise Infeasible(reasons[0] if reasons else "no gain was found", "P", 0.0)


def more_tolerant(
    fallbacks: Sequence[Feedback], plant: LinearPlant, progress: Progress, fixed: Rest | None
) -> Iterator[Feedback]:
    """Yields a fallback that bears larger radii than given ones, around a fixed point or the one that suits it.

    None where these bear so little that a search has never made up for it.
    """

    def margin_of(scaled: np.ndarray) -> float:
        needs = needs_of(first._replace(K=scaled * units), plant)
        if needs is None:
            return 0.0
        return (distances(plant, fixed) / needs).min() if fixed else farthest_equilibrium(plant, needs).distance

    if not fallbacks:
        return
    first, units = fallbacks[0], plant.input_half[:, None] / plant.half_widths
    best = max((each.K / units for each in fallbacks), key=margin_of)
    if margin_of(best) >= HOPELESS:
        progress("gain that tolerates more")
        K = more_tolerant_gain(best, margin_of).K * units
        yield first._replace(K=K, rest=fixed or farthest_equilibrium(plant, needs_of(first._replace(K=K), plant)).rest)


def fallbacks_around(
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Progress,
    fixed: Rest | None = None,
    known: Sequence[np.ndarray] | None = None,
) -> list[Feedback]:
    """Returns what may keep a polytope around a resting point: those that keep the most of the box first.

    Where no share of the box is known, those whose resting point leaves what the gain needs come first.

    Args:
        plant: The plant.
        contract: Channel contract; None for none.
        progress: Called with a line of text now and then.
        fixed: The resting point; the one that suits each gain by default.
        known: Gains, shape (m, n), that are tried as well; by default that of the largest ellipsoid, which is sought.

    Raises:
        Infeasible: If the plant has no error set, or no resting point.
    """
    rest = fixed or farthest_from_limits(plant)
    problem, errors = design_problem(plant, contract, limits_around(plant, rest))
    shapes = np.array([proof.Sigma for proof in proofs_of(errors)])

    def feedback(K: np.ndarray, at: Rest) -> Feedback:
        return Feedback(K, shapes, _disturbance_around(plant, at), at)

    gains = [*(_ellipsoid_gain(problem, progress) if known is None else known), *_gains(plant, problem, progress)]
    suited = [(K, Farthest(rest, 1.0, np.empty(0, int)) if fixed else rest_for(K, plant, errors, rest)) for K in gains]
    tried = [feedback(K, at.rest) for K, at in sorted(suited, key=lambda pair: pair[1].distance < 1.0)]
    points = points_of_box(plant, _POINTS_OF_REST_LOG2)
    if points is None or not tried:
        return tried
    shares = [share_of_points(each, plant, points) for each in tried]
    tried = [tried[k] for k in np.argsort(-np.array(shares), kind="stable")]
    if fixed:
        return tried
    progress(f"resting point: {100.0 * max(shares):.1f} % of the box")
    K = tried[0].K
    rest = improved(plant, tried[0].rest, lambda at: share_of_points(feedback(K, at), plant, points))
    return [feedback(K, rest), *tried]


def _different(fallbacks: Sequence[Feedback], plant: LinearPlant) -> list[Feedback]:
    """Returns fallbacks in their order, of those that are the same in a certificate's digits the first."""
    keys = [(gain_in_digits(each.K, plant).tobytes(), each.rest.state.tobytes()) for each in fallbacks]
    return [each for number, each in enumerate(fallbacks) if keys[number] not in keys[:number]]


def _ellipsoid_gain(problem: DesignProblem, progress: Progress) -> list[np.ndarray]:
    """Returns the gain of the largest ellipsoid, shape (m, n), for symmetric limits around a point, if there is one."""

    def report(stage: str, design: CandidateDesign | None) -> None:
        progress(progress_text(stage, design))

    found = largest_set(problem, SLACKS[0], report)
    return [] if found is None else [problem.to_physical(found.L, with_best_gain(problem, found).K)[1]]


def _gains(plant: LinearPlant, problem: DesignProblem, progress: Progress) -> Iterator[np.ndarray]:
    """Yields gains, shape (m, n), of the largest tolerated radii within symmetric limits, and of regulators."""
    progress("gain that tolerates most")
    start = max_margin_gain(problem, problem.covering_error_shape)
    if start is not None:
        yield problem.to_physical(start.L, start.K)[1]
        yield problem.to_physical(start.L, most_tolerant_gain(problem, start).K)[1]
    yield from regulators(plant)


def rest_for(K: np.ndarray, plant: LinearPlant, errors: ErrorSet, rest: Rest) -> Farthest:
    """Returns the resting point that suits a gain, shape (m, n): where the limits leave most of what it needs.

    What the gain needs is there if the nearest limit is 1 away; where that is not known, it is said to be.
    """
    shapes = np.array([proof.Sigma for proof in proofs_of(errors)])
    needs = needs_of(Feedback(K, shapes, _disturbance_around(plant, rest), rest), plant)
    return Farthest(rest, 1.0, np.empty(0, int)) if needs is None else farthest_equilibrium(plant, needs)


def _disturbance_around(plant: LinearPlant, rest: Rest) -> np.ndarray:
    """Returns D with what a resting point lacks of an equilibrium, shape (n, n)."""
    missing = plant.A @ rest.state + plant.B @ rest.input - rest.state
    D = plant.disturbance.shape_matrix
    if missing.any():
        missing = np.abs(missing) + _OF_REST * (np.abs(plant.A) @ np.abs(rest.state) + np.abs(rest.state))
        D = outer_sum(D, plant.n * np.diag(missing**2), plant.relative_weight)
    return inflated(D)


def _verified_polytope(certificate: Certificate, plant: LinearPlant, progress: Progress) -> Certificate:
    """Returns a certificate with a polytope, verified, with the polytope's size.

    Raises:
        Infeasible: If it does not verify.
    """
    assert certificate.polytope is not None
    progress(f"exact verification: a polytope of {len(certificate.polytope.rows)} rows")
    report = verify(certificate, plant)
    if not report.valid:
        failed = next(condition for condition in report.conditions if not condition.holds)
        reason = f"in exact arithmetic {failed.name} fails by {-failed.margin:.3g}: {MORE_DIGITS}"
        raise Infeasible(reason, "P", -failed.margin)
    shares = {
        "polytope_share_of_box": share_in_polytope(certificate.polytope, plant),
        "share_of_last_input": share_of_last_input(certificate.polytope, plant),
    }
    sizes = {name: float(exact.rounded(share, 3)) for name, share in shares.items() if share is not None}
    reach = {} if "polytope_share_of_box" in sizes else reach_recorded(certificate.polytope, plant)
    others = {name: value for name, value in certificate.provenance.items() if name != "reach"}
    return replace(certificate, provenance=others | sizes | reach)


def polytope_share(certificate: Certificate) -> float:
    """Returns the share of the safe box that a certificate's polytope fills, as far as it is known; 0.0 otherwise."""
    return certificate.provenance.get("polytope_share_of_box", 0.0)
