"""Why a design problem is infeasible: what binds, by how much, and less age that would help."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ncs_gym import ChannelContract, LinearPlant
from ncs_gym.estimation.error_bound import unseen_state
from ncs_gym.estimation.error_bounds_by_age import error_sets_by_age
from ncs_gym.estimation.error_sets import ErrorSetError
from ncs_gym.limits import FREE_REACH
from ncs_gym.plants.description import row_limit
from shields.errors import Infeasible
from shields.synthesis.design_problem import DesignProblem, design_problem
from shields.synthesis.initial_designs import SUFFICIENT_MARGIN
from shields.synthesis.invariant_polytope import Feedback
from shields.synthesis.max_margin_gain import max_margin_gain
from shields.synthesis.polytope_gain import (
    HOPELESS,
    ellipsoid_margin,
    most_tolerant_gain,
    needs_of,
    polytope_margin,
    regulators,
)
from shields.synthesis.resting_point import (
    farthest_equilibrium,
    farthest_from_limits,
    limits_around,
    needs_resting_point,
)
from shields.synthesis.search import Progress

# Digits of the share of the radii that is named.
_SHOWN_DIGITS = 3
# Of contracts, where there is none, none for older samples is named [steps].
_OLDEST_NAMED = 32
# For so many ages that a quick search found feasible a certificate is sought.
_MOST_AGES = 2
# In the details of the exception: the fraction of all radii that a gain bears.
_SHARE = "share_of_radii"


# Whether a plant has a certificate under a contract.
Certifies = Callable[[ChannelContract], bool]


def infeasibility(
    plant: LinearPlant, contract: ChannelContract | None, *, polytope: bool, reason: str = ""
) -> Infeasible:
    """Returns the exception that names the binding condition and the fraction of the radii that is feasible.

    Args:
        plant: The plant.
        contract: Channel contract, if there is one.
        polytope: Whether a polytope alone would do, too.
        reason: Why the polytope of a gain that bears the radii was given up.

    Raises:
        Infeasible: If there is no design problem.
    """
    if needs_resting_point(plant):
        problem, tolerance = None, _tolerance_around(plant, contract)
    else:
        problem, _ = design_problem(plant, contract)
        tolerance = _Tolerance(_margin(problem, polytope=polytope))
    if tolerance.margin == 0.0:
        return _unstabilized(plant)
    if polytope and tolerance.margin >= 1.0:
        what = "(P) a gain bears disturbances and errors within the limits, but its polytope was not found"
        return Infeasible(f"{what}: {reason}", "P", 0.0)
    k, m, binding = len(plant.box), plant.m, tolerance.binding
    if problem is not None:
        inputs_bind = _margin(problem, polytope=polytope, input_limits=False) >= 1.0
        missing = "ellipsoid or polytope in the box" if polytope else "ellipsoid in the box"
    else:
        inputs_bind = len(binding) > 0 and all(k <= j < k + m for j in binding)
        missing = "polytope within the limits"
    named = f" (those that bind: {', '.join(row_limit(plant, j) for j in binding)})" if binding else ""
    what = (
        "(U) no gain was found that keeps the input limits"
        if inputs_bind
        else f"(I) no invariant {missing} was found{named}"
    )
    return _with_share(what, what[1], min(tolerance.margin, 1.0))


def _unstabilized(plant: LinearPlant) -> Infeasible:
    unstabilized = "(I) no gain was found that stabilizes the plant, whatever the bounds are"
    unmoved = unseen_state(plant.A.T, plant.B.T, 1.0 / plant.half_widths, plant.state_names)
    if unmoved is not None:
        unstabilized = f"(I) no gain stabilizes the plant: no input moves {unmoved}, which does not decay by itself"
    return Infeasible(unstabilized, "I", 1.0, {_SHARE: 0.0})


def _with_share(what: str, binding: str, fraction: float) -> Infeasible:
    return Infeasible(f"{what}: {_once(fraction)}", binding, 1.0 - fraction, {_SHARE: fraction})


def _once(fraction: float) -> str:
    """Returns for which fraction of all radii there is a certificate, as the rest of a sentence."""
    return (
        "a quick search finds one once disturbance and error radii shrink to "
        f"{100.0 * fraction:.{_SHOWN_DIGITS}g}% of those given"
    )


def with_age_that_helps(
    infeasible: Infeasible,
    plant: LinearPlant,
    contract: ChannelContract | None,
    certifies: Certifies,
    progress: Progress = lambda line: None,
    *,
    polytope: bool = True,
) -> Infeasible:
    """Returns the exception with the limits that a disturbance exceeds alone, and a max_age that has a certificate.

    Args:
        infeasible: The exception without these.
        plant: The plant for which no certificate was found.
        contract: The channel contract. No age is sought where none helps, nor for an unstable plant without a contract:
            the exception is then returned as it is.
        certifies: Whether the plant has a certificate under a contract.
        progress: Called with a line of text.
        polytope: Whether a polytope alone would do, too.
    """
    if not _may_be_helped(infeasible, plant, contract):
        return infeasible
    below = contract or ChannelContract(_OLDEST_NAMED + 1)
    age = _largest_age(plant, below, certifies, progress, polytope=polytope)
    text, details = f"{infeasible}{_limits_exceeded(plant)}{_limits_out_of_reach(plant)}", dict(infeasible.details)
    if age is not None:
        details["max_age"] = age
        text += f"; there is a certificate for max_age = {age}"
        text += "" if contract else f", which a contract of the channel promises (contract=ChannelContract({age}))"
    text += f" (asked: max_age = {contract.max_age})" if contract else ""
    return Infeasible(text, infeasible.binding, infeasible.shortfall, details)


def _may_be_helped(infeasible: Infeasible, plant: LinearPlant, contract: ChannelContract | None) -> bool:
    """Returns whether less age may help: not against too many rows of a polytope, where a gain bears all."""
    if infeasible.binding == "E1":
        return contract is not None and _has_error_sets(plant, replace(contract, max_age=0))
    return infeasible.binding not in ("S", "P") and infeasible.details.get(_SHARE) != 0.0


def _has_error_sets(plant: LinearPlant, contract: ChannelContract) -> bool:
    try:
        error_sets_by_age(plant, contract)
    except ErrorSetError:
        return False
    return True


def _largest_age(
    plant: LinearPlant, contract: ChannelContract, certifies: Certifies, progress: Progress, *, polytope: bool
) -> int | None:
    """Returns a max_age below the contract's that has a certificate, by bisection; None if few are tried in vain."""
    low, high = -1, contract.max_age
    while high - low > 1:
        progress("search for a max_age that has a certificate")
        middle = (low + high) // 2
        if is_feasible(plant, replace(contract, max_age=middle), polytope=polytope):
            low = middle
        else:
            high = middle
    tried = [age for age in sorted({low, (3 * low) // 4, low // 2}, reverse=True) if age >= 0][:_MOST_AGES]
    return next((age for age in tried if certifies(replace(contract, max_age=age))), None)


def _limits_exceeded(plant: LinearPlant) -> str:
    """Returns which limits of the safe box a disturbance or a first error alone exceeds, as the rest of a sentence."""
    two_ends = np.flatnonzero(np.isfinite(plant.box_ends).all(axis=0)).tolist()
    alone = {
        "the disturbance of one step": plant.nominal_disturbance,
        "the error of the first estimate": plant.nominal_initial_error,
    }
    return "".join(
        f"; {what} alone reaches {size:.3g} times the limit {row_limit(plant, j)}"
        for what, shape in alone.items()
        for j, size in enumerate(np.ravel(shape.support(plant.box)).tolist())
        if size >= 1.0 and j in two_ends
    )


def _limits_out_of_reach(plant: LinearPlant) -> str:
    """Returns which limits nothing comes near, and which mislead the search, as the rest of a sentence."""
    alone = (np.count_nonzero(plant.box, axis=1) == 1) & ~plant.is_past_row
    out_of_reach = np.abs(plant.box) @ (FREE_REACH * plant.reach_from_rest) < 1.0
    names = [row_limit(plant, j) for j in np.flatnonzero(alone & out_of_reach).tolist()]
    if not names:
        return ""
    return (
        f"; inputs and disturbances take no state to a hundredth of {', '.join(names)} in {plant.n} steps: leave out "
        "limits that stand for none"
    )


def is_feasible(plant: LinearPlant, contract: ChannelContract | None, *, polytope: bool) -> bool:
    """Returns whether a gain is found that bears the plant's radii.

    Args:
        plant: The plant.
        contract: Channel contract, if there is one.
        polytope: Whether it is enough that it keeps a polytope.
    """
    try:
        if needs_resting_point(plant):
            return _tolerance_around(plant, contract, SUFFICIENT_MARGIN).margin >= SUFFICIENT_MARGIN
        problem, _ = design_problem(plant, contract)
        return _margin(problem, polytope=polytope, enough=SUFFICIENT_MARGIN) >= SUFFICIENT_MARGIN
    except Infeasible:
        return False


class _Tolerance(NamedTuple):
    """The factor on all radii that the best gain bears, and the limits, as in `distances`, that it reaches first."""

    margin: float
    binding: tuple[int, ...] = ()


def _tolerance_around(plant: LinearPlant, contract: ChannelContract | None, enough: float = np.inf) -> _Tolerance:
    """Returns what the best gain bears that is found for limits with two ends, around the resting point that suits it.

    Args:
        plant: The plant.
        contract: Channel contract, if there is one.
        enough: A factor beyond which no larger one is sought.

    Raises:
        Infeasible: If there is no error set, or no equilibrium within the limits.
    """
    rest = farthest_from_limits(plant)
    problem, errors = design_problem(plant, contract, limits_around(plant, rest))

    def tolerance(K: np.ndarray, at_least: float = 0.0) -> _Tolerance:
        needs = needs_of(Feedback(K, errors.promised, plant.disturbance.shape_matrix, rest), plant)
        if needs is None:
            return _Tolerance(at_least)
        farthest = farthest_equilibrium(plant, needs)
        return _Tolerance(max(farthest.distance, at_least), tuple(farthest.binding.tolist()))

    start = max_margin_gain(problem, problem.covering_error_shape)
    gains = [(K, 0.0) for K in regulators(plant)]
    if start is not None:  # the problem is without limits of states and inputs together
        margin = 0.0 if len(plant.mixed_rows) else start.margin
        gains.insert(0, (problem.to_physical(start.L, start.K)[1], margin))
    best = _Tolerance(0.0)
    for K, at_least in gains:
        best = max(best, tolerance(K, at_least), key=lambda each: each.margin)
        if best.margin >= enough:
            return best
    if start is None or best.margin < HOPELESS:
        return best
    K = problem.to_physical(start.L, most_tolerant_gain(problem, start, SUFFICIENT_MARGIN).K)[1]
    return max(best, tolerance(K), key=lambda each: each.margin)


def _margin(problem: DesignProblem, *, polytope: bool, input_limits: bool = True, enough: float = np.inf) -> float:
    """Returns the factor on all radii that the best gain bears; 0 if no gain stabilizes.

    Args:
        problem: The scaled design problem.
        polytope: Whether it is enough that it keeps a polytope; no better gain is sought for that without input limits.
        input_limits: False leaves the input limits out.
        enough: A factor beyond which no larger one is sought.
    """
    gain = max_margin_gain(problem, problem.covering_error_shape, input_limits=input_limits)
    if gain is None:
        return 0.0
    of_ellipsoid = ellipsoid_margin(problem, gain, input_limits=input_limits)
    if not polytope or of_ellipsoid >= enough:
        return of_ellipsoid
    at_hand = max(of_ellipsoid, polytope_margin(problem, gain.K, input_limits=input_limits))
    if not input_limits or at_hand < HOPELESS:
        return at_hand
    return max(at_hand, most_tolerant_gain(problem, gain, enough).margin)
