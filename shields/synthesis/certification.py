"""Certificates for a plant: candidates, the exact check, why there is none, and what carries over to other problems."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ncs_gym import LinearPlant, exact
from ncs_gym.network.contract import ChannelContract
from ncs_gym.validation import as_number, as_vector, shown
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.synthesis.alternating_optimization import ALTERNATIONS
from shields.synthesis.design_problem import Rest
from shields.synthesis.diagnosis import infeasibility, with_age_that_helps
from shields.synthesis.ellipsoid_certificates import certify, largest_ellipsoid
from shields.synthesis.polytope_certificates import (
    around_resting_point,
    certify_polytope,
    polytope_share,
    with_polytope,
)
from shields.synthesis.resting_point import at_operating_point, needs_resting_point, resting_at
from shields.synthesis.search import Progress, Search
from shields.synthesis.tolerance import most_tolerated, tolerated_gains
from shields.verification import verify

# Alternations of a search that begins near the design of a similar problem.
_FEW_ALTERNATIONS = 4


@np.errstate(all="ignore")
def synthesize(
    plant: LinearPlant,
    *,
    contract: ChannelContract | None = None,
    safe_set: str | None = None,
    resting_state: ArrayLike | None = None,
    time_limit: float | None = None,
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
        time_limit: Seconds of the processor's time, > 0, after which the best certificate so far is verified and
            returned, and says so. None for no limit: the search then ends by counted work, on every machine alike.
        progress: Called with a line of text per stage: what is sought, and the volume reached so far.

    Raises:
        Infeasible: If no certificate is found; it names the binding condition and the shortfall, or the time limit.
        SynthesisInterrupted: A KeyboardInterrupt that says what was reached, with the best certificate so far.
        ValueError: If an argument is out of range.
    """
    if not isinstance(plant, LinearPlant):
        raise ValueError(f"plant must be a LinearPlant, got {type(plant).__name__}")
    if not (safe_set is None or (isinstance(safe_set, str) and safe_set in ("ellipsoid", "polytope"))):
        raise ValueError(f"safe_set must be 'polytope', 'ellipsoid' or None, got {shown(safe_set)}")
    if not isinstance(contract, ChannelContract | None):
        raise ValueError(
            "contract must be ChannelContract(max_age=...), or contract_of(channel) for a Channel that keeps one, or "
            f"None, got {shown(contract)}"
        )
    if time_limit is not None:
        as_number(time_limit, "time_limit", low=0.0, low_open=True)
    polytope, rest = safe_set != "ellipsoid", None
    if resting_state is not None or needs_resting_point(plant):
        if not polytope:
            raise ValueError(
                "only a polytope is sought where limits are not symmetric, not all states have any, some are of states "
                "and inputs together, or resting_state is given"
            )
        rest = None if resting_state is None else resting_at(plant, as_vector(resting_state, plant.n, "resting_state"))
    search = Search(progress, time_limit)
    try:
        found = _found(plant, contract, search, rest, polytope=polytope)
        if isinstance(found, Certificate):
            search.candidate = lambda: found
            return with_polytope(found, plant, search) if polytope else found
        search.refusal = found
        if rest is not None:  # changes are sought for a resting point of the synthesis' own choice
            given = "this is around the resting_state that was given, without one the synthesis chooses"
            raise Infeasible(f"{found}; {given}", found.binding, found.shortfall)

        def certifies(promised: ChannelContract) -> bool:
            return nearby_certificate(plant, promised, polytope=polytope, progress=search) is not None

        raise with_age_that_helps(found, plant, contract, certifies, search, polytope=polytope)
    except TimeoutError:
        return search.best_in_time(plant)
    except KeyboardInterrupt as interrupt:
        raise search.interrupted(plant) from interrupt


def _found(
    plant: LinearPlant,
    contract: ChannelContract | None,
    search: Search,
    rest: Rest | None = None,
    start: Certificate | None = None,
    alternations: int = ALTERNATIONS,
    *,
    polytope: bool,
) -> Certificate | Infeasible:
    """Returns a verified certificate, of an ellipsoid if one is found, else of a polytope alone, or why there is none.

    Where most states are past inputs, a polytope alone comes first.

    Raises:
        TimeoutError, KeyboardInterrupt: Where the search is ended; it holds what was reached.
    """
    is_centered = rest is None and not needs_resting_point(plant)
    fixed, found, failure = at_operating_point(plant) if is_centered else rest, None, None
    sought = ["ellipsoid"] * is_centered + ["polytope"] * polytope
    if 2 * plant.past > plant.n:  # an ellipsoid of mostly past inputs takes minutes, and adds nothing
        sought.reverse()
    try:
        search("gains, and what they bear")
        gains = tolerated_gains(plant, contract, fixed)
        while sought and found is None:
            search.candidate = None
            try:
                if sought.pop(0) == "polytope":
                    found = around_resting_point(plant, contract, gains, search, fixed)
                else:
                    found = largest_ellipsoid(plant, contract, [each.K for each in gains], search, start, alternations)
            except Infeasible as none:
                failure = failure or none
        if found is None:
            return failure or infeasibility(plant, most_tolerated(plant, contract, polytope=False), polytope=False)
    except Infeasible as none:
        return none
    scale = max([1.0, *(each.margin for each in gains)])  # it is 1 at least, because this certificate exists
    return replace(found, provenance=found.provenance | {"tolerated_scale": float(exact.rounded(scale, 3))})


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
    carried = None if start is None else carried_over(start, plant, contract)
    alone = polytope and (carried is None or needs_resting_point(plant))
    found = _found(plant, contract, Search(progress), None, start, _FEW_ALTERNATIONS, polytope=alone)
    if not isinstance(found, Certificate):
        return carried
    return found if carried is None or found.keeps_ellipsoid else max(found, carried, key=polytope_share)
