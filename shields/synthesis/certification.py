"""Certificates for a plant: gains, candidates, the exact check, the polytope around the best, or why there is none."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from ncs_gym import LinearPlant, exact
from ncs_gym.network.channel import ChannelContract
from ncs_gym.validation import as_number, shown
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.synthesis.diagnosis import infeasibility, with_limits_out_of_proportion
from shields.synthesis.ellipsoid_certificates import largest_ellipsoid
from shields.synthesis.invariant_polytope import Progress
from shields.synthesis.polytope_certificates import around_resting_point, reason_of, with_polytope
from shields.synthesis.resting_point import needs_resting_point
from shields.synthesis.tolerance import most_tolerated, tolerated_gains
from shields.verification import verify


class Search:
    """Takes lines of progress, and raises `TimeoutError` once the limit of the processor's time [s] is over.

    Attributes:
        candidate: Makes the best certificate so far, not yet verified; None while there is none.
    """

    def __init__(self, progress: Progress | None = None, time_limit: float | None = None) -> None:
        self._progress, self._limit = progress, time_limit
        self._end = math.inf if time_limit is None else time.thread_time() + time_limit
        self._stage = "start"
        self.candidate: Callable[[], Certificate] | None = None

    def __call__(self, line: str) -> None:
        """Takes a line of progress: the stage, a colon, and what is reached."""
        self._stage = line.partition(":")[0]
        if self._progress is not None:
            self._progress(line)
        if time.thread_time() >= self._end:
            raise TimeoutError

    def best_in_time(self, plant: LinearPlant) -> Certificate:
        """Returns the best certificate so far, verified, where the time is over; raises Infeasible if there is none."""
        over = f"the time_limit of {self._limit:g} s was over"
        best = None if self.candidate is None else self.candidate()
        if best is None or not verify(best, plant).valid:
            raise Infeasible(f"{over} at {self._stage}, before a certificate was found: give more, or None", "T", 0.0)
        return best.recording({"interrupted_at": f"{self._stage}, when {over}"})


@np.errstate(all="ignore")
def synthesize(
    plant: LinearPlant,
    *,
    contract: ChannelContract | None = None,
    safe_set: str | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Certificate:
    """Returns a verified certificate; that of the published method is `shields.paper.synthesize`.

    It seeks the largest ellipsoid with hard bounds, and the polytope of its gain in its place (docs/shield_proof.md).
    Where there is no ellipsoid, a polytope alone is sought: it bears larger disturbances and errors.

    Args:
        plant: The plant with its bounds, Schur stable without a contract.
        contract: Channel contract; with one, the error sets depend on the age of the newest sample.
        safe_set: What a shield keeps: "polytope", the largest one that the gain of the ellipsoid keeps in the box
            (docs/shield_proof.md, "Polytopes"), or "ellipsoid". Where there is no polytope within limits of rows and
            time the ellipsoid stays, and the printed certificate says why. None is "polytope".
        time_limit: Seconds of the processor's time, > 0, after which the best certificate so far is verified and
            returned, and says so. None for no limit: the search then ends by counted work, on every machine alike.
        progress: Called with a line of text per stage: what is sought, and the volume reached so far.

    Raises:
        Infeasible: If no certificate is found; it names the binding condition and the shortfall, or the time limit.
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
    polytope = safe_set != "ellipsoid"
    if not (polytope or _may_keep_ellipsoid(plant)):
        raise ValueError(
            "only a polytope is sought where limits are not symmetric, not all states have any, or some are of states "
            "and inputs together, or between samples"
        )
    search = Search(progress, time_limit)
    try:
        found = first_certificate(plant, contract, search, polytope=polytope)
        return with_polytope(found, plant, search) if polytope else found
    except TimeoutError:
        return search.best_in_time(plant)


def first_certificate(
    plant: LinearPlant, contract: ChannelContract | None, search: Search, *, polytope: bool = True
) -> Certificate:
    """Returns a verified certificate of an ellipsoid, or of a polytope alone where no ellipsoid is found.

    Where most states are past inputs, a polytope alone comes first: an ellipsoid takes minutes there and adds nothing.

    Raises:
        Infeasible: If none is found.
        TimeoutError: If the time of the search is over.
    """
    candidates = [largest_ellipsoid] * _may_keep_ellipsoid(plant) + [around_resting_point] * polytope
    if 2 * plant.past > plant.n:
        candidates.reverse()
    failure = None
    try:
        search("gains, and what they bear")
        gains = tolerated_gains(plant, contract)
        scale = max([1.0, *(each.margin for each in gains)])  # at least 1 where there is a certificate
        for best_of in candidates:
            search.candidate = None
            try:
                found = best_of(plant, contract, gains, search)
            except Infeasible as none:
                failure = failure or none
            else:
                if found is not None:
                    return found.recording({"tolerated_scale": float(exact.rounded(scale, 3))})
        failure = failure or infeasibility(plant, most_tolerated(plant, contract, polytope=False), polytope=False)
    except Infeasible as none:
        failure = none
    except np.linalg.LinAlgError as error:
        failure = Infeasible(reason_of(error), "S", 1.0)
    raise with_limits_out_of_proportion(failure, plant)


def _may_keep_ellipsoid(plant: LinearPlant) -> bool:
    return plant.is_symmetric and not needs_resting_point(plant)
