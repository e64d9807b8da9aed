"""Certificates for a plant: synthesized with a set of largest volume, or for a given set and gain."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ncs_gym import ErrorSet, LinearPlant, exact
from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.linear_plant import inflated
from ncs_gym.uncertainty.shape_matrices import outer_sum
from ncs_gym.validation import as_flag, as_vector, own_error_state, shown
from shields.certificate import Certificate, Proof, Updates
from shields.certificate_text import size_of
from shields.errors import CertificateError, Infeasible, SynthesisInterrupted
from shields.synthesis.alternating_optimization import largest_set, with_best_gain
from shields.synthesis.design_problem import (
    CandidateDesign,
    DesignProblem,
    Rest,
    SymmetricLimits,
    design_problem,
)
from shields.synthesis.diagnosis import (
    Clock,
    infeasibility,
    infeasibility_around,
    is_feasible,
    with_feasible_bounds,
)
from shields.synthesis.initial_designs import SUFFICIENT_MARGIN
from shields.synthesis.invariant_polytope import (
    LONGEST_SEARCH,
    Feedback,
    feedback_of,
    invariant_polytope,
    limits_within_step,
    points_of_box,
    share_in_polytope,
    share_of_points,
)
from shields.synthesis.max_margin_gain import max_margin_gain
from shields.synthesis.multipliers import best_input_multipliers, best_multipliers, with_best_multipliers
from shields.synthesis.polytope_gain import (
    ellipsoid_margin,
    gains_of_larger_polytopes,
    most_tolerant_gain,
    needs_of,
    regulators,
)
from shields.synthesis.resting_point import (
    Farthest,
    at_operating_point,
    farthest_equilibrium,
    farthest_from_limits,
    improved,
    limits_around,
    needs_resting_point,
    resting_at,
)
from shields.synthesis.round_numbers import in_round_numbers
from shields.synthesis.semidefinite_programs import largest_box_ellipsoid
from shields.synthesis.share_of_box import share_of_box
from shields.verification import Report, verify

# Relative tightenings of the semidefinite programs, tried in turn until the result verifies exactly.
_SLACKS = (1e-6, 1e-5, 1e-4, 1e-3)
# Where a set leaves the box between samples, one in a box that is smaller by what is missing and this is sought, so
# many times at most.
_BETWEEN_MARGIN, _MOST_BOXES = 1e-3, 8
# Significant digits of the numbers of a certificate: what differs between processors beyond them is cut off. Sizes
# that are for people have fewer.
_DIGITS, _SHOWN_DIGITS = 12, 6
# The largest ellipsoid in a polytope is shrunk to this in its faces, more than its digits are rounded by.
_INSIDE = 1.0 - 1e-9
# Points of the box by which resting points are compared.
_POINTS_OF_REST_LOG2 = 12
# In the details of an `Infeasible`: a candidate was found that does not hold in exact arithmetic.
_LOST = "lost_in_exact_arithmetic"
# What an equilibrium lacks is computed with an error of at most this, relative to its terms.
_OF_REST = 1e-14
# What helps where float64 has too few digits.
_MORE_DIGITS = (
    "give states units in which the half-widths of the box are of similar size, and leave out rows of the box that are "
    "nearly the same as others"
)
# Where no set is found, half-widths of the box that differ by more are named as the reason.
_WIDEST_SPREAD = 1e6
# A refusal should take so long at most [s], of its thread's own time: the search for a polytope, and then
# the one for changes that would help, end so much earlier, since what is under way then takes some seconds.
LONGEST_REFUSAL, _UNDER_WAY = 60.0, 10.0
# What ends the search for a polytope: a reason, or numbers that a linear program cannot hold.
_NOT_CERTIFIED = (Infeasible, ArithmeticError, ValueError, CertificateError)
# Called with a line of text: the stage, and the volume reached so far.
Progress = Callable[[str], object]
# Alternations of a search that begins near the design of a similar problem.
_FEW_ALTERNATIONS = 4
# Where no certificate is found, these fractions of the input limits are tried: wide limits can mislead the search.
_LIMIT_FRACTIONS = (0.5, 0.25, 0.1)
# What a certificate records that does not depend on its gain.
_OF_THE_PLANT = ("tolerated_scale",)
# Multipliers from which those of a given set and gain are sought.
_INITIAL_MULTIPLIERS = (0.9, 0.03, 0.07)


@own_error_state
def synthesize(
    plant: LinearPlant,
    method: str = "certified",
    *,
    contract: ChannelContract | None = None,
    safe_set: str | None = None,
    search_gain: bool = False,
    resting_state: ArrayLike | None = None,
    progress: Progress | None = None,
    candidates: Sequence[Certificate] = (),
) -> Certificate:
    """Returns a verified certificate.

    It seeks the largest ellipsoid with hard bounds, and the polytope around it (docs/shield_proof.md). Where there is
    no ellipsoid, a polytope alone is sought: it bears larger disturbances and errors.

    Args:
        plant: The plant with its bounds, Schur stable without a contract.
        method: "certified"; the published method is `shields.paper.synthesize`.
        contract: Channel contract; with one, the error sets depend on the age of the newest sample.
        safe_set: What a shield keeps: "polytope", the largest one that the gain of the ellipsoid keeps in the box
            (docs/shield_proof.md, "Polytopes"), or "ellipsoid". Where there is no polytope within limits of rows and
            time the ellipsoid stays, and the printed certificate says why. None is "polytope".
        search_gain: Also seek the gain whose polytope is the largest, which takes about as long again, longer for
            polytopes of many rows. That gain keeps the polytope alone.
        resting_state: Equilibrium around which the fallback works, shape (n,) [deviations from the operating point],
            for a polytope; by default the operating point where limits are symmetric about it, else one that leaves
            much of the box.
        progress: Called with a line of text per stage: what is sought, and the volume reached so far.
        candidates: Certificates of tighter problems (closer limits, larger bounds, an older age, a coarser
            quantization). The search is local; no set that one of them proves here is larger than the result's, so that
            more room is never less.

    Raises:
        Infeasible: If no certificate is found; it names the binding condition and the shortfall.
        SynthesisInterrupted: A KeyboardInterrupt that says what was reached, with the best certificate so far.
        ValueError: If an argument is out of range.
    """
    if not isinstance(plant, LinearPlant):
        raise ValueError(f"plant must be a LinearPlant, got {type(plant).__name__}")
    if not isinstance(method, str) or method != "certified":
        raise ValueError(f"method must be 'certified' (the paper's is shields.paper.synthesize), got {shown(method)}")
    if not (safe_set is None or (isinstance(safe_set, str) and safe_set in ("ellipsoid", "polytope"))):
        raise ValueError(f"safe_set must be 'polytope', 'ellipsoid' or None, got {shown(safe_set)}")
    if not all(isinstance(each, Certificate) for each in candidates):
        raise ValueError("candidates must be certificates")
    as_flag(search_gain, "search_gain")
    if safe_set == "ellipsoid" and search_gain:
        raise ValueError("search_gain is for polytopes: the search for an ellipsoid finds its gain")
    if contract is not None and not isinstance(contract, ChannelContract):
        raise ValueError(
            "contract must be ChannelContract(max_age=...), or contract_of(channel) for a Channel that keeps one, or "
            f"None, got {shown(contract)}"
        )
    report, clock = progress or (lambda line: None), Clock(time.thread_time() + LONGEST_REFUSAL - _UNDER_WAY)
    if resting_state is not None or needs_resting_point(plant):
        if safe_set == "ellipsoid":
            raise ValueError(
                "only a polytope is sought where limits are not symmetric, not all states have any, some are of states "
                "and inputs together, or resting_state is given"
            )
        rest = None if resting_state is None else resting_at(plant, as_vector(resting_state, plant.n, "resting_state"))
        try:
            return _around_resting_point(plant, contract, report, candidates, clock, rest, search_gain=search_gain)
        except Infeasible as infeasible:
            if rest is not None:  # changes are sought for a resting point of the synthesis' own choice
                raise Infeasible(
                    f"{infeasible}; this is around the resting_state that was given, without one the synthesis chooses",
                    infeasible.binding,
                    infeasible.shortfall,
                ) from infeasible
            raise _with_changes(infeasible, plant, contract, report, clock, polytope=True) from infeasible
    known = [each for given in candidates if (each := carried_over(given, plant, contract)) is not None]
    if safe_set == "ellipsoid":
        known = [each.without_polytope() for each in known if each.keeps_ellipsoid]
    largest, *others = _certificates(plant, contract, report, known, clock, polytope=safe_set != "ellipsoid")
    if safe_set == "ellipsoid":
        return largest
    found = (with_largest_polytope if search_gain else with_polytope)(largest, plant, report)
    return max([found, *(with_polytope(each, plant, report) for each in others)], key=_polytope_share)


def _around_resting_point(
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Progress,
    candidates: Sequence[Certificate],
    clock: Clock,
    fixed: Rest | None = None,
    *,
    search_gain: bool,
) -> Certificate:
    """Returns a verified certificate of a polytope for limits that are not symmetric about the operating point.

    The gain is sought within symmetric limits around the equilibrium that is farthest from all limits, or around a
    fixed one; where the share of the box is known, a better resting point then, and with `search_gain` a better gain.
    Once the clock has run out, no further gain is tried.

    Raises:
        Infeasible: If none is found.
    """
    progress("resting point")
    known = [each for given in candidates if (each := carried_over(given, plant, contract)) is not None]
    if fixed is not None:
        known = [each for each in known if np.array_equal(each.resting_state, fixed.state)]
    rest = fixed or farthest_from_limits(plant)
    problem, errors = design_problem(plant, contract, limits_around(plant, rest))
    shapes = np.array([proof.Sigma for proof in _proofs(errors)])
    points = points_of_box(plant, _POINTS_OF_REST_LOG2)

    def feedback(K: np.ndarray, at: Rest) -> Feedback:
        return Feedback(K, shapes, _disturbance_around(plant, at), at)

    gains = _gains_around(plant, problem, progress)
    suited = [(K, Farthest(rest, 1.0, np.empty(0, int)) if fixed else _rest_for(K, plant, errors, rest)) for K in gains]
    tried = [feedback(K, at.rest) for K, at in sorted(suited, key=lambda pair: pair[1].distance < 1.0)]
    if points is not None and tried:
        shares = [share_of_points(each, plant, points) for each in tried]
        tried = [tried[k] for k in np.argsort(-np.array(shares), kind="stable")]
        K, first = tried[0].K, tried[0].rest
        progress(f"resting point: {100.0 * max(shares):.1f} % of the box")
        better = tried[0]
        if not fixed:
            better = feedback(K, improved(plant, first, lambda at: share_of_points(feedback(K, at), plant, points)))
        larger = gains_of_larger_polytopes(better, plant, progress) if search_gain else ()
        tried = [*(feedback(each, better.rest) for each in larger), better, *tried]
    reasons = []
    for each in tried:
        try:
            longest = min(LONGEST_SEARCH, clock.left)
            found = _certified_polytope(plant, each.K, contract, progress, each.rest, longest)
            return max([found, *known], key=_polytope_share)
        except _NOT_CERTIFIED as failure:
            reasons.append(str(failure))
        if clock.is_over:
            break
    if known:
        return max(known, key=_polytope_share)
    reason = reasons[0] if reasons else "no gain was found"
    raise Infeasible(reason, "P", 0.0) if fixed else infeasibility_around(plant, contract, reason)


def _rest_for(K: np.ndarray, plant: LinearPlant, errors: ErrorSet, rest: Rest) -> Farthest:
    """Returns the resting point that suits a gain, shape (m, n): where the limits leave most of what it needs.

    What the gain needs is there if the nearest limit is 1 away; where that is not known, it is said to be.
    """
    shapes = np.array([proof.Sigma for proof in _proofs(errors)])
    needs = needs_of(Feedback(K, shapes, _disturbance_around(plant, rest), rest), plant)
    return Farthest(rest, 1.0, np.empty(0, int)) if needs is None else farthest_equilibrium(plant, needs)


def _gains_around(
    plant: LinearPlant, problem: DesignProblem, progress: Progress, *, quick: bool = False
) -> Iterator[np.ndarray]:
    """Yields gains, shape (m, n), for symmetric limits around a point.

    Those of the largest ellipsoid, which takes longest and is left out if `quick`, of the largest tolerated radii, and
    of regulators.
    """

    def report(stage: str, design: CandidateDesign | None) -> None:
        progress(_progress_text(stage, design))

    found = None if quick else largest_set(problem, _SLACKS[0], report)
    if found is not None:
        yield problem.to_physical(found.L, with_best_gain(problem, found).K)[1]
    progress("gain that tolerates most")
    start = max_margin_gain(problem, problem.covering_error_shape)
    if start is not None:
        yield problem.to_physical(start.L, start.K)[1]
        yield problem.to_physical(start.L, most_tolerant_gain(problem, start).K)[1]
    yield from regulators(plant)


def with_polytope(certificate: Certificate, plant: LinearPlant, progress: Progress = lambda line: None) -> Certificate:
    """Returns a verified certificate with the largest polytope that its gain keeps in the box.

    One that keeps a polytope alone is returned as it is. Without a polytope if none is found; its provenance, and so
    the printed certificate, says why.

    Args:
        certificate: A verified one.
        plant: Its plant.
        progress: Called with a line of text now and then.

    Raises:
        SynthesisInterrupted: A KeyboardInterrupt with the certificate as it was.
    """
    if not certificate.keeps_ellipsoid:
        return certificate
    try:
        polytope = invariant_polytope(feedback_of(certificate), plant, progress)
        return _verified_polytope(replace(certificate, polytope=polytope), plant, progress)
    except Infeasible as none:
        reason = str(none)
    except (ArithmeticError, ValueError, CertificateError) as error:  # numbers that a linear program cannot hold
        reason = f"its numbers are out of reach of float64 ({error}): {_MORE_DIGITS}"
    except KeyboardInterrupt as interrupt:
        message = "interrupted while a polytope was sought; the certificate has the ellipsoid"
        raise SynthesisInterrupted(message, certificate) from interrupt
    return replace(certificate, provenance=certificate.provenance | {"no_polytope": reason})


def with_largest_polytope(
    certificate: Certificate, plant: LinearPlant, progress: Progress = lambda line: None
) -> Certificate:
    """Returns what `with_polytope` does, with the gain whose polytope is the largest that a search finds.

    Another gain than the certificate's keeps the polytope alone; what the certificate's own would have kept is in the
    provenance.

    Args:
        certificate: A verified one.
        plant: Its plant.
        progress: Called with a line of text now and then.

    Raises:
        SynthesisInterrupted: A KeyboardInterrupt with the certificate, and its own gain's polytope if that was found.
    """
    own = with_polytope(certificate, plant, progress)
    try:
        for K in gains_of_larger_polytopes(feedback_of(certificate), plant, progress):
            found = certify_polytope(plant, K, certificate.contract, progress)
            if found is not None and _polytope_share(found) > _polytope_share(own):
                kept = {name: certificate.provenance[name] for name in _OF_THE_PLANT if name in certificate.provenance}
                gained = {"share_with_gain_of_ellipsoid": _polytope_share(own)} if own.keeps_ellipsoid else {}
                return replace(found, provenance=found.provenance | kept | gained)
    except KeyboardInterrupt as interrupt:
        message = "interrupted while a gain with a larger polytope was sought; the certificate has the first gain's"
        raise SynthesisInterrupted(message, own) from interrupt
    except (ArithmeticError, ValueError, CertificateError):  # a gain whose numbers are out of reach of float64
        pass
    return own


def _polytope_share(certificate: Certificate) -> float:
    """Returns the share of the safe box that a certificate's polytope fills, as far as it is known; 0.0 otherwise."""
    return certificate.provenance.get("polytope_share_of_box", 0.0)


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
        reason = f"in exact arithmetic {failed.name} fails by {-failed.margin:.3g}: {_MORE_DIGITS}"
        raise Infeasible(reason, "P", -failed.margin)
    share = share_in_polytope(certificate.polytope, plant)
    size = {} if share is None else {"polytope_share_of_box": float(exact.rounded(share, 3))}
    return replace(certificate, provenance=certificate.provenance | size)


@own_error_state
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
    certificate = replace(_certificate(plant, problem, design, errors, 0.0), L=L, K=K)
    return certificate if verify(certificate, plant).valid else None


def certify_polytope(
    plant: LinearPlant,
    K: np.ndarray,
    contract: ChannelContract | None = None,
    progress: Progress = lambda line: None,
    rest: Rest | None = None,
    longest: float | None = None,
) -> Certificate | None:
    """Returns a verified certificate with the largest polytope that a given gain keeps in the box; None for none.

    The polytope alone is claimed to be invariant; L is that of the largest ellipsoid inside it.

    Args:
        plant: The plant with its bounds.
        K: Gain, shape (m, n) [input per state].
        contract: Channel contract; with one, the error sets depend on the age of the newest sample.
        progress: Called with a line of text now and then.
        rest: The point around which it is sought; the operating point by default.
        longest: How long the polytope is sought at most [s], as in `invariant_polytope`.

    Raises:
        Infeasible: If the plant has no error set or its safe box is unbounded.
    """
    try:
        rest = at_operating_point(plant) if rest is None else rest
        return _certified_polytope(plant, K, contract, progress, rest, longest)
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
    longest: float | None,
) -> Certificate:
    """Returns what `certify_polytope` does.

    Raises:
        Infeasible, ArithmeticError, ValueError, CertificateError: If there is none; the message says why.
    """
    problem, errors = design_problem(plant, contract, limits_around(plant, rest))
    K, proofs = exact.rounded(K, _DIGITS, axis=1), _proofs(errors)
    feedback = Feedback(K, np.array([proof.Sigma for proof in proofs]), _disturbance_around(plant, rest), rest)
    polytope = invariant_polytope(feedback, plant, progress, longest)
    faces = polytope.F
    L = largest_box_ellipsoid(polytope.rows if polytope.is_symmetric else faces)
    L = _in_digits(L * (_INSIDE / ((faces @ L) * faces).sum(axis=1).max()))
    others: dict[str, Any] = _of_the_problem(plant, problem, errors) | {"D": feedback.D}
    others |= {"resting_state": rest.state, "resting_input": rest.input}
    provenance = _provenance(plant, L, _volume(plant, L))
    certificate = Certificate(L=L, K=K, proofs=proofs, polytope=polytope, provenance=provenance, **others)
    return _verified_polytope(certificate, plant, progress)


def _disturbance_around(plant: LinearPlant, rest: Rest) -> np.ndarray:
    """Returns D with what a resting point lacks of an equilibrium, shape (n, n)."""
    missing = plant.A @ rest.state + plant.B @ rest.input - rest.state
    D = plant.disturbance.shape_matrix
    if missing.any():
        missing = np.abs(missing) + _OF_REST * (np.abs(plant.A) @ np.abs(rest.state) + np.abs(rest.state))
        D = outer_sum(D, plant.n * np.diag(missing**2), plant.relative_weight)
    return inflated(D)


def carried_over(certificate: Certificate, plant: LinearPlant, contract: ChannelContract | None) -> Certificate | None:
    """Returns a certificate of a tighter problem as one of this problem; None if it does not verify here.

    A problem is tighter with larger bounds, closer limits, an older largest age or a coarser quantization. A
    certificate of the same plant is returned as it is: channels that keep this contract keep its own. For another plant
    its ellipsoid and gain are proved anew, with this plant's error sets; where its gain keeps a polytope alone, that.

    Args:
        certificate: A verified one.
        plant: The plant.
        contract: What the channel promises; None for nothing.
    """
    promised = certificate.contract
    if plant.fingerprint == certificate.fingerprint:
        covered = promised is None or (
            contract is not None
            and contract.max_age <= promised.max_age
            and contract.quantization_step <= promised.quantization_step
        )
        return certificate if covered and verify(certificate, plant).valid else None
    if certificate.L.shape != (plant.n, plant.n) or certificate.K.shape != (plant.m, plant.n):
        return None
    try:
        if certificate.keeps_ellipsoid:
            return certify(plant, certificate.L, certificate.K, contract)
        rest = Rest(certificate.resting_state, certificate.resting_input)
        return certify_polytope(plant, certificate.K, contract, rest=rest)
    except Infeasible:
        return None


def nearby_certificate(
    plant: LinearPlant,
    contract: ChannelContract | None,
    start: Certificate | None = None,
    alternations: int = _FEW_ALTERNATIONS,
    *,
    polytope: bool = True,
    progress: Progress = lambda line: None,
) -> Certificate | None:
    """Returns a verified certificate, found faster and with a slightly smaller set than `synthesize`; None if none is.

    Args:
        plant: The plant with its bounds.
        contract: Channel contract; None for none.
        start: Certificate of a similar problem with as many states and inputs, which the search begins near.
        alternations: How often the set is enlarged at most.
        polytope: Whether a polytope is sought where no ellipsoid is found.
        progress: Called with a line of text now and then.
    """
    if needs_resting_point(plant):
        return _nearby_around(plant, contract, start, progress)
    try:
        certificate = _nearby(plant, contract, start, alternations, progress)
    except Infeasible:
        certificate = None
    carried = None if certificate or start is None else carried_over(start, plant, contract)
    return certificate or carried or (_polytope_alone(plant, contract, progress) if polytope else None)


def _nearby_around(
    plant: LinearPlant, contract: ChannelContract | None, start: Certificate | None, progress: Progress
) -> Certificate | None:
    """Returns what `nearby_certificate` does, of a polytope around a resting point: the first that is found."""
    carried = None if start is None else carried_over(start, plant, contract)
    if carried is not None:
        return carried
    try:
        rest = farthest_from_limits(plant)
        problem, errors = design_problem(plant, contract, limits_around(plant, rest))
        for K in _gains_around(plant, problem, progress, quick=True):
            suited = _rest_for(K, plant, errors, rest)
            found = certify_polytope(plant, K, contract, progress, suited.rest) if suited.distance >= 1.0 else None
            if found is not None:
                return found
    except Infeasible:
        pass
    return None


def _nearby(
    plant: LinearPlant,
    contract: ChannelContract | None,
    start: Certificate | None,
    alternations: int,
    progress: Progress,
    tightened: tuple[np.ndarray, ...] = (),
) -> Certificate | None:
    """Returns what `nearby_certificate` searches, in the boxes of `_found_certificate`.

    Raises:
        Infeasible: If the plant has no error set, or the state leaves every box between two samples.
    """
    problem, errors = design_problem(plant, contract, _within(plant, tightened))
    near = None

    def report(stage: str, design: CandidateDesign | None) -> None:
        progress(_progress_text(stage, design))

    if start is not None and (shares := start.proofs[-1].shares) is not None:
        lx, le, ld = shares.tolist()
        near = _design_at(problem, start.L, start.K, (lx, le, ld))
    for slack in _SLACKS:
        found = largest_set(problem, slack, report, near, alternations)
        if found is None:
            return None
        certificate = _certificate(plant, problem, with_best_gain(problem, found), errors, slack)
        box_rows = _tightened_box(certificate, plant, tightened)
        if box_rows is not None:
            return _nearby(plant, contract, start, alternations, progress, (*tightened, box_rows))
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


def _certificates(
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Progress,
    known: Sequence[Certificate],
    clock: Clock,
    *,
    polytope: bool,
) -> list[Certificate]:
    """Returns the verified certificate that is found and known ones, that of the largest ellipsoid first.

    Those of a polytope alone come last; where there is no other and `polytope` says so, one is sought.
    """

    def size(certificate: Certificate) -> tuple[bool, float]:
        return certificate.keeps_ellipsoid, float(np.linalg.slogdet(certificate.L)[1])

    try:
        known = [_found_certificate(plant, contract, progress), *known]
    except Infeasible as infeasible:
        if not known:
            known = [_second_search(infeasible, plant, contract, progress, clock, polytope=polytope)]
    return sorted(known, key=size, reverse=True)


def _second_search(
    infeasible: Infeasible,
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Progress,
    clock: Clock,
    *,
    polytope: bool,
) -> Certificate:
    """Returns a verified certificate that is found in other ways where the search for an ellipsoid found none.

    Raises:
        Infeasible: If there is none; with the bounds that would be feasible.
    """
    if polytope and _LOST in infeasible.details:
        progress("no ellipsoid holds in exact arithmetic: seeking a polytope")
        try:
            return _around_resting_point(plant, contract, progress, (), clock, search_gain=False)
        except Infeasible:
            raise infeasible from None
    was_sought = "share_of_radii" in infeasible.details
    certificate = _with_closer_limits(plant, contract) if was_sought else None
    if certificate is None and polytope and (was_sought or infeasible.binding == "B"):
        progress("no ellipsoid: seeking the gain whose polytope bears most")
        certificate = _polytope_alone(plant, contract, progress, min(LONGEST_SEARCH, clock.left))
    if certificate is not None:
        return certificate
    if was_sought or infeasible.binding in ("B", "E1"):
        raise _with_hints(infeasible, plant, contract, progress, clock, polytope=polytope) from infeasible
    raise infeasible


def _with_closer_limits(plant: LinearPlant, contract: ChannelContract | None) -> Certificate | None:
    """Returns a certificate that is found with closer input limits and holds for the plant's own; None if none is."""
    for fraction in _LIMIT_FRACTIONS if plant.remainder is None else ():
        closer = replace(plant, u_max=fraction * plant.u_max)
        certifies = is_feasible(closer, contract, polytope=False)
        found = nearby_certificate(closer, contract, polytope=False) if certifies else None
        certificate = found and carried_over(found, plant, contract)
        if certificate is not None:
            return certificate
    return None


def _polytope_alone(
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Progress = lambda line: None,
    longest: float | None = None,
) -> Certificate | None:
    """Returns a verified certificate of a polytope for the gain that bears the largest radii; None if none is found.

    Raises:
        SynthesisInterrupted: A KeyboardInterrupt.
    """
    try:
        problem, _ = design_problem(plant, contract)
        start = max_margin_gain(problem, problem.covering_error_shape)
        gain = start and most_tolerant_gain(problem, start)
        if gain is None or gain.margin < SUFFICIENT_MARGIN:
            return None
        _, K = problem.to_physical(np.eye(plant.n), gain.K)
        found = certify_polytope(plant, K, contract, progress, longest=longest)
    except Infeasible:
        return None
    except KeyboardInterrupt as interrupt:
        message = "interrupted while a polytope was sought, and had no certificate yet"
        raise SynthesisInterrupted(message) from interrupt
    record = {"tolerated_scale": float(exact.rounded(gain.margin, 3))}
    return found and replace(found, provenance=found.provenance | record)


def _found_certificate(
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
        progress(_progress_text(*reached))

    try:
        for slack in _SLACKS:
            found = largest_set(problem, slack, report)
            if found is None:
                break
            for design in _finished(problem, found, slack):
                report("exact verification", design)
                certificate = _certificate(plant, problem, design, errors, slack)
                box_rows = _tightened_box(certificate, plant, tightened)
                if box_rows is not None:
                    return _found_certificate(plant, contract, progress, (*tightened, box_rows))
                verification = verify(certificate, plant)
                if verification.valid:
                    return _with_tolerated_scale(certificate, problem)
                failure = _failed_verification(verification)
    except KeyboardInterrupt as interrupt:
        stage, design = reached
        best = design and _certificate(plant, problem, with_best_gain(problem, design), errors, slack)
        raise _interrupted(plant, stage, best) from interrupt
    if tightened and not failure:  # there is a set in the plant's box
        raise _leaves_between_samples(float(np.abs(tightened[-1]).max() / np.abs(plant.box_rows).max() - 1.0))
    if not failure and (spread := float(plant.half_widths.max() / plant.half_widths.min())) > _WIDEST_SPREAD:
        failure = Infeasible(
            f"the plant is too ill-conditioned for this search, its half-widths differ by a factor of {spread:.0e}: "
            f"{_MORE_DIGITS}",
            "I",
            1.0,
        )
    raise failure or infeasibility(problem, polytope=False)


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


def _finished(problem: DesignProblem, found: CandidateDesign, slack: float) -> Iterator[CandidateDesign]:
    """Yields a design of the search in round numbers, if there is one, and then with the gain of most slack."""
    rounded = in_round_numbers(problem, found, slack)
    if rounded is not None:
        yield rounded
    yield with_best_gain(problem, found)


def _with_hints(
    infeasible: Infeasible,
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Progress,
    clock: Clock,
    *,
    polytope: bool,
) -> Infeasible:
    """Returns the exception with the changes that would help, where no ellipsoid was found.

    Raises:
        SynthesisInterrupted: A KeyboardInterrupt that says why there is no certificate.
    """
    if polytope and infeasible.binding != "E1":
        sought = infeasibility(design_problem(plant, contract)[0], polytope=True)
        polytope = sought.shortfall > 0.0  # of one that exists but is out of reach there is nothing to say
        infeasible = sought if polytope and infeasible.binding != "B" else infeasible
    return _with_changes(infeasible, plant, contract, progress, clock, polytope=polytope)


def _with_changes(
    infeasible: Infeasible,
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Progress,
    clock: Clock,
    *,
    polytope: bool,
) -> Infeasible:
    """Returns the exception with single changes that have a certificate.

    Raises:
        SynthesisInterrupted: A KeyboardInterrupt that says why there is no certificate.
    """

    def certifies(changed: LinearPlant, promised: ChannelContract | None, within: Clock) -> bool:
        return nearby_certificate(changed, promised, polytope=polytope, progress=within.check) is not None

    try:
        return with_feasible_bounds(
            infeasible, plant, contract, progress, polytope=polytope, certifies=certifies, clock=clock
        )
    except KeyboardInterrupt as interrupt:
        raise SynthesisInterrupted(f"interrupted while feasible bounds were sought: {infeasible}") from interrupt


def _progress_text(stage: str, design: CandidateDesign | None) -> str:
    """Returns a line of progress."""
    volume = "no set yet" if design is None else f"{math.exp(0.5 * design.log_det):.4f} of the box ellipsoid's volume"
    return f"{stage}: {volume}"


def _interrupted(plant: LinearPlant, stage: str, best: Certificate | None) -> SynthesisInterrupted:
    """Returns the exception for an interrupted search, with the best certificate so far if it verifies."""
    message = f"interrupted: the synthesis was at {stage}"
    if best is None or not verify(best, plant).valid:
        return SynthesisInterrupted(f"{message} and had no certificate yet")
    size = size_of(best.provenance)
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
        f"a candidate was found, but in exact arithmetic {failed.name} fails by {-failed.margin:.3g}: {_MORE_DIGITS}",
        failed.name.split()[0].strip("():"),
        -failed.margin,
        {_LOST: -failed.margin},
    )


def _certificate(
    plant: LinearPlant, problem: DesignProblem, design: CandidateDesign, errors: ErrorSet, slack: float
) -> Certificate:
    """Returns the certificate of a design, not yet verified."""
    L, K = problem.to_physical(design.L, design.K)
    L, K = _in_digits(L), exact.rounded(K, _DIGITS, axis=1)
    volume = float(np.exp(0.5 * design.log_det)) * _share_of_ellipsoid(plant, problem)
    return Certificate(
        L=L,
        K=K,
        proofs=_proofs(errors, problem, design),
        **_of_the_problem(plant, problem, errors),
        provenance=_provenance(plant, L, volume) | {"slack": slack},
    )


def _in_digits(L: np.ndarray) -> np.ndarray:
    """Returns a shape, (n, n), with entries of few digits."""
    extents = np.array([float(exact.rounded(extent, 1)) for extent in np.sqrt(np.diag(L))])
    units = np.outer(extents, extents)
    return np.round(L / units, _DIGITS) * units


def _of_the_problem(plant: LinearPlant, problem: DesignProblem, errors: ErrorSet) -> dict[str, Any]:
    """Returns the fields of a certificate that set and gain have no part in."""
    return {
        "D": inflated(plant.disturbance.shape_matrix),
        "rounding": problem.rounding,
        "updates": _updates(errors),
        "between_samples": plant.between_samples,
        "fingerprint": plant.fingerprint,
    }


def _provenance(plant: LinearPlant, L: np.ndarray, volume: float) -> dict[str, Any]:
    """Returns how a certificate was made, and `_description` of its ellipsoid."""
    solver = f"Clarabel {version('clarabel')} through cvxpy {version('cvxpy')}"
    return {"source": "docs/shield_proof.md", "solver": solver} | _description(plant, L, volume)


def _volume(plant: LinearPlant, L: np.ndarray) -> float:
    """Returns the volume of an ellipsoid in units of the largest one in the safe box; NaN where that is unbounded."""
    if np.linalg.matrix_rank(plant.box) < plant.n:
        return math.nan
    return float(np.linalg.det(np.linalg.solve(largest_box_ellipsoid(plant.box), L)) ** 0.5)


def _share_of_ellipsoid(plant: LinearPlant, problem: DesignProblem) -> float:
    """Returns the volume of the largest ellipsoid in the box that a set was sought in; that of the plant's box is 1."""
    if plant.grid_rows is None:
        return 1.0
    own = np.linalg.cholesky(largest_box_ellipsoid(plant.box_rows))
    return float(np.exp(np.log(np.diag(problem.transform)).sum() - np.log(np.diag(own)).sum()))


def _description(plant: LinearPlant, L: np.ndarray, volume: float) -> dict[str, Any]:
    """Returns what a reader of the certificate wants to know about its set and its plant.

    Args:
        plant: The plant.
        L: Shape of the set, (n, n).
        volume: Volume of the set in units of the largest ellipsoid in the safe box.
    """
    sizes = {"volume_of_box_ellipsoid": volume} | share_of_box(plant, L)
    sizes = {name: size for name, size in sizes.items() if not (isinstance(size, float) and math.isnan(size))}
    description: dict[str, Any] = {
        name: float(exact.rounded(size, _SHOWN_DIGITS)) if isinstance(size, float) else size
        for name, size in sizes.items()
    }
    assumptions = getattr(plant, "assumptions", ())
    if assumptions:
        description["assumptions"] = [assumptions] if isinstance(assumptions, str) else list(assumptions)
    return description


def _proofs(
    errors: ErrorSet, problem: DesignProblem | None = None, design: CandidateDesign | None = None
) -> tuple[Proof, ...]:
    """Returns a proof per error set, with the multipliers of an ellipsoid that suit it best if a design is given."""
    if errors.ages is None:
        sets, designs = [(errors.Sigma, errors.rate)], [design]
    else:
        sets = list(zip(errors.ages.shapes[:-1], errors.ages.rates.tolist(), strict=True))
        designs = [None] * len(sets)
        if problem is not None and design is not None:
            designs = [with_best_multipliers(problem, design, Sigma[None]) for Sigma in problem.error_shapes]
    return tuple(
        Proof(Sigma=Sigma, rate=rate)
        if each is None
        else Proof(Sigma=Sigma, rate=rate, shares=_rounded_down(each.multipliers), inputs=each.inputs)
        for (Sigma, rate), each in zip(sets, designs, strict=True)
    )


def _updates(errors: ErrorSet) -> Updates | None:
    """Returns what a channel contract adds to the proofs; None without one."""
    sets = errors.ages
    if sets is None:
        return None
    return Updates(
        contract=sets.contract, last=sets.shapes[-1], gains=sets.gains, shares=sets.multipliers, noise=sets.noise
    )


def _rounded_down(multipliers: tuple[float, float, float]) -> np.ndarray:
    """Returns multipliers of few digits, so much smaller that rounding cannot lift lx + le + ld above 1."""
    return np.array([float(exact.rounded((1.0 - 1e-11) * each, _DIGITS)) for each in multipliers])
