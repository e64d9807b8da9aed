"""Certificates for a plant: which search is for it, what helps where none is found, and what carries over."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ncs_gym import LinearPlant
from ncs_gym.network.contract import ChannelContract
from ncs_gym.validation import as_vector, shown
from shields.certificate import Certificate
from shields.errors import Infeasible, SynthesisInterrupted
from shields.synthesis.design_problem import Rest, design_problem
from shields.synthesis.diagnosis import Clock, infeasibility, is_feasible, with_age_that_helps
from shields.synthesis.ellipsoid_certificates import LOST, Progress, certify, largest_ellipsoid, nearby_ellipsoid
from shields.synthesis.polytope_certificates import (
    around_resting_point,
    certify_polytope,
    fallbacks_around,
    most_tolerant_polytope,
    polytope_share,
    with_polytope,
)
from shields.synthesis.resting_point import needs_resting_point, resting_at
from shields.verification import verify

# A refusal should take so long at most [s], of its thread's own time: searches after the first for a polytope, and then
# for an age that would help, begin no later than so much earlier. One that is under way goes on: where polytopes have
# very many rows, a refusal has been seen to take 82 s.
LONGEST_REFUSAL, _UNDER_WAY = 60.0, 10.0
# Alternations of a search that begins near the design of a similar problem.
_FEW_ALTERNATIONS = 4
# Where no certificate is found, these fractions of the input limits are tried: wide limits can mislead the search.
_LIMIT_FRACTIONS = (0.5, 0.25, 0.1)


@np.errstate(all="ignore")
def synthesize(
    plant: LinearPlant,
    *,
    contract: ChannelContract | None = None,
    safe_set: str | None = None,
    resting_state: ArrayLike | None = None,
    progress: Progress | None = None,
) -> Certificate:
    """Returns a verified certificate; that of the published method is `shields.paper.synthesize`.

    It seeks the largest ellipsoid with hard bounds, and the polytope around it (docs/shield_proof.md). Where there is
    no ellipsoid, a polytope alone is sought: it bears larger disturbances and errors.

    Args:
        plant: The plant with its bounds, Schur stable without a contract.
        contract: Channel contract; with one, the error sets depend on the age of the newest sample.
        safe_set: What a shield keeps: "polytope", the largest one that the gain of the ellipsoid keeps in the box
            (docs/shield_proof.md, "Polytopes"), or "ellipsoid". Where there is no polytope within limits of rows and
            time the ellipsoid stays, and the printed certificate says why. None is "polytope".
        resting_state: Equilibrium around which the fallback works, shape (n,) [deviations from the operating point],
            for a polytope; by default the operating point where limits are symmetric about it, else one that leaves
            much of the box.
        progress: Called with a line of text per stage: what is sought, and the volume reached so far.

    Raises:
        Infeasible: If no certificate is found; it names the binding condition and the shortfall.
        SynthesisInterrupted: A KeyboardInterrupt that says what was reached, with the best certificate so far.
        ValueError: If an argument is out of range.
    """
    if not isinstance(plant, LinearPlant):
        raise ValueError(f"plant must be a LinearPlant, got {type(plant).__name__}")
    if not (safe_set is None or (isinstance(safe_set, str) and safe_set in ("ellipsoid", "polytope"))):
        raise ValueError(f"safe_set must be 'polytope', 'ellipsoid' or None, got {shown(safe_set)}")
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
            return around_resting_point(plant, contract, report, clock, rest)
        except Infeasible as infeasible:
            if rest is not None:  # changes are sought for a resting point of the synthesis' own choice
                raise Infeasible(
                    f"{infeasible}; this is around the resting_state that was given, without one the synthesis chooses",
                    infeasible.binding,
                    infeasible.shortfall,
                ) from None
            raise _with_changes(infeasible, plant, contract, report, clock, polytope=True) from None
    polytope = safe_set != "ellipsoid"
    try:
        found = largest_ellipsoid(plant, contract, report)
    except Infeasible as infeasible:
        found = _second_search(infeasible, plant, contract, report, clock, polytope=polytope)
    return with_polytope(found, plant, report) if polytope else found


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
        covered = promised is None or promised.follows_from(contract)
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
    *,
    polytope: bool = True,
    progress: Progress = lambda line: None,
) -> Certificate | None:
    """Returns a verified certificate, found faster than by `synthesize`, of a smaller set; None if none is.

    Args:
        plant: The plant with its bounds.
        contract: Channel contract; None for none.
        start: Certificate of a similar problem with as many states and inputs, which the search begins near.
        polytope: Whether a polytope is sought where no ellipsoid is found.
        progress: Called with a line of text now and then.
    """
    if needs_resting_point(plant):
        return _nearby_around(plant, contract, start, progress)
    try:
        certificate = nearby_ellipsoid(plant, contract, start, _FEW_ALTERNATIONS, progress)
    except Infeasible:
        certificate = None
    carried = None if certificate or start is None else carried_over(start, plant, contract)
    return certificate or carried or (most_tolerant_polytope(plant, contract, progress) if polytope else None)


def _nearby_around(
    plant: LinearPlant,
    contract: ChannelContract | None,
    start: Certificate | None,
    progress: Progress,
) -> Certificate | None:
    """Returns what `nearby_certificate` does, of a polytope around a resting point."""
    carried = None if start is None else carried_over(start, plant, contract)
    try:
        for each in fallbacks_around(plant, contract, progress, quick=True):
            found = certify_polytope(plant, each.K, contract, progress, each.rest)
            if found is not None:
                return found if carried is None else max([found, carried], key=polytope_share)
    except Infeasible:
        pass
    return carried


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
    if polytope and LOST in infeasible.details:
        progress("no ellipsoid holds in exact arithmetic: seeking a polytope")
        try:
            return around_resting_point(plant, contract, progress, clock)
        except Infeasible:
            raise infeasible from None
    was_sought = "share_of_radii" in infeasible.details
    certificate = _with_closer_limits(plant, contract) if was_sought else None
    if certificate is None and polytope and (was_sought or infeasible.binding == "B"):
        progress("no ellipsoid: seeking the gain whose polytope bears most")
        certificate = most_tolerant_polytope(plant, contract, progress)
    if certificate is not None:
        return certificate
    if was_sought or infeasible.binding in ("B", "E1"):
        raise _with_hints(infeasible, plant, contract, progress, clock, polytope=polytope) from None
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


def _with_hints(
    infeasible: Infeasible,
    plant: LinearPlant,
    contract: ChannelContract | None,
    progress: Progress,
    clock: Clock,
    *,
    polytope: bool,
) -> Infeasible:
    """Returns the exception with an age that would help, where no ellipsoid was found.

    Raises:
        SynthesisInterrupted: A KeyboardInterrupt that says why there is no certificate.
    """
    if polytope and infeasible.binding != "E1":
        sought = infeasibility(plant, design_problem(plant, contract)[0], polytope=True)
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
    """Returns the exception with an age of samples that has a certificate.

    Raises:
        SynthesisInterrupted: A KeyboardInterrupt that says why there is no certificate.
    """

    def certifies(promised: ChannelContract) -> bool:
        return nearby_certificate(plant, promised, polytope=polytope, progress=clock.check) is not None

    try:
        return with_age_that_helps(infeasible, plant, contract, certifies, clock, progress, polytope=polytope)
    except KeyboardInterrupt as interrupt:
        raise SynthesisInterrupted(f"interrupted while feasible ages were sought: {infeasible}") from interrupt
