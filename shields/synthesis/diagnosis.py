"""Why no certificate was found, and by how much."""

from __future__ import annotations

from dataclasses import replace

from ncs_gym import ChannelContract, LinearPlant
from shields.errors import Infeasible
from shields.synthesis.design_problem import design_problem
from shields.synthesis.initial_designs import ENOUGH
from shields.synthesis.max_margin_gain import roomiest_gain
from shields.synthesis.semidefinite_programs import ScaledProblem

# Of the gamma asked for, and the ratio it is found to.
SMALLEST_GAMMA, GAMMA_PRECISION = 1e-6, 1.02


def with_what_works(reason: Infeasible, plant: LinearPlant, contract: ChannelContract | None) -> Infeasible:
    """Returns the exception with the largest age, and at the age asked for the largest gamma, that are borne.

    Args:
        reason: What stands in the way.
        plant: The plant it stands in the way of.
        contract: The channel's promise; without one the exception is returned as it is.
    """
    if contract is None or reason.binding == "S":
        return reason
    hints, details = [str(reason)], dict(reason.details)
    if contract.max_age > 0:
        age = _largest_age(plant, contract)
        hints.append("no smaller max_age works either" if age is None else f"max_age = {age} is the largest that works")
        details |= {} if age is None else {"max_age": age}
    if plant.gamma > 0.0:
        gamma = _largest_gamma(plant, contract)
        hints.append(
            "no smaller gamma works either" if gamma is None else f"gamma = {gamma:.3g} is the largest that works"
        )
        details |= {} if gamma is None else {"largest_gamma": gamma}
    message = f"{'; '.join(hints)} (asked: max_age = {contract.max_age}, gamma = {plant.gamma:g})"
    return Infeasible(message, reason.binding, reason.shortfall, details)


def _works(plant: LinearPlant, contract: ChannelContract) -> bool:
    """Returns whether a gain bears the radii."""
    try:
        problem, _ = design_problem(plant, contract)
    except Infeasible:
        return False
    return _share(problem) >= ENOUGH


def _largest_age(plant: LinearPlant, contract: ChannelContract) -> int | None:
    """Returns the largest max_age below the contract's that works, None if none does."""
    low, high = -1, contract.max_age
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _works(plant, replace(contract, max_age=middle)) else (low, middle)
    return low if low >= 0 else None


def _largest_gamma(plant: LinearPlant, contract: ChannelContract) -> float | None:
    """Returns the largest gamma below the plant's that works, nearly; None if none above a millionth of it does."""
    low, high = SMALLEST_GAMMA * plant.gamma, plant.gamma
    if not _works(replace(plant, gamma=low), contract):
        return None
    while high > GAMMA_PRECISION * low:
        middle = (low * high) ** 0.5
        low, high = (middle, high) if _works(replace(plant, gamma=middle), contract) else (low, middle)
    return low


def diagnosis(problem: ScaledProblem) -> Infeasible:
    """Returns the exception that says what binds, and the share of the radii that a gain bears."""
    share = min(_share(problem), 1.0)
    binding = "U" if _share(problem, limited=False) >= 1.0 else "I"
    what = "(U) the input limits are too tight" if binding == "U" else "(I) no invariant ellipsoid in the box was found"
    return Infeasible(
        f"{what}: one is found once disturbance and error radii shrink to {share:.1%} of those given",
        binding,
        1.0 - share,
        {"share_of_radii": share},
    )


def _share(problem: ScaledProblem, *, limited: bool = True) -> float:
    """Returns the share of the radii that the best gain found bears; 0 if none stabilizes."""
    gain = roomiest_gain(problem, problem.covering, limited=limited)
    return 0.0 if gain is None else gain.reach
