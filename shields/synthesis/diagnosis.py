"""Why a design problem is infeasible: what binds, by how much, and less age that would help."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ncs_gym import ChannelContract, LinearPlant
from ncs_gym.estimation.error_bound import unseen_state
from ncs_gym.estimation.error_bounds_by_age import error_sets_by_age
from ncs_gym.estimation.error_sets import ErrorSetError
from ncs_gym.plants.description import row_limit
from ncs_gym.plants.hard_bounds import FREE_REACH
from shields.errors import Infeasible
from shields.synthesis.search import Progress
from shields.synthesis.tolerance import SUFFICIENT_MARGIN, Tolerated, most_tolerated

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


def infeasibility(plant: LinearPlant, tolerated: Tolerated | None, *, polytope: bool, reason: str = "") -> Infeasible:
    """Returns the exception that names the binding condition and the fraction of the radii that is feasible.

    Args:
        plant: The plant.
        tolerated: What the best gain bears; None if no gain stabilizes.
        polytope: Whether a polytope alone would do, too.
        reason: Why the polytope of a gain that bears the radii was given up.
    """
    if tolerated is None:
        return _unstabilized(plant)
    if polytope and tolerated.margin >= 1.0:
        what = "(P) a gain bears disturbances and errors within the limits, but its polytope was not found"
        return Infeasible(f"{what}: {reason}", "P", 0.0)
    k, m, binding = len(plant.box), plant.m, tolerated.binding
    fraction = min(tolerated.margin, 1.0)
    missing = "set within the limits" if polytope else "ellipsoid in the box"
    what = (
        "(U) no gain was found that keeps the input limits"
        if binding and all(k <= j < k + m for j in binding)
        else f"(I) no invariant {missing} was found"
    )
    named = f" (those that bind: {', '.join(dict.fromkeys(row_limit(plant, j) for j in binding))})" if binding else ""
    once = f"a quick search finds one once disturbance and error radii shrink to {100.0 * fraction:.{_SHOWN_DIGITS}g}%"
    return Infeasible(f"{what}{named}: {once} of those given", what[1], 1.0 - fraction, {_SHARE: fraction})


def _unstabilized(plant: LinearPlant) -> Infeasible:
    unstabilized = "(I) no gain was found that stabilizes the plant, whatever the bounds are"
    unmoved = unseen_state(plant.A.T, plant.B.T, 1.0 / plant.half_widths, plant.state_names)
    if unmoved is not None:
        unstabilized = f"(I) no gain stabilizes the plant: no input moves {unmoved}, which does not decay by itself"
    return Infeasible(unstabilized, "I", 1.0, {_SHARE: 0.0})


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
    return infeasible.binding not in ("S", "P", "R") and infeasible.shortfall < 1.0


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
        if _is_feasible(plant, replace(contract, max_age=middle), polytope=polytope):
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


def _is_feasible(plant: LinearPlant, contract: ChannelContract, *, polytope: bool) -> bool:
    """Returns whether a gain is found that bears the plant's radii."""
    try:
        found = most_tolerated(plant, contract, polytope=polytope, enough=SUFFICIENT_MARGIN)
    except Infeasible:
        return False
    return found is not None and found.margin >= SUFFICIENT_MARGIN
