"""Why a design problem is infeasible, and which bounds would be feasible."""

from __future__ import annotations

from dataclasses import replace

from ncs_gym import ChannelContract, LinearPlant
from shields.errors import Infeasible
from shields.synthesis.design_problem import DesignProblem, design_problem
from shields.synthesis.initial_designs import SUFFICIENT_MARGIN
from shields.synthesis.max_margin_gain import max_margin_gain

# The largest feasible gamma is sought down to this fraction of the given one, and to this ratio.
_SMALLEST_GAMMA, _GAMMA_PRECISION = 1e-6, 1.02


def infeasibility(problem: DesignProblem) -> Infeasible:
    """Returns the exception that names the binding condition and the fraction of the radii that is feasible."""
    fraction = min(_margin(problem), 1.0)
    binding = "U" if _margin(problem, input_limits=False) >= 1.0 else "I"
    what = "(U) the input limits are too tight" if binding == "U" else "(I) no invariant ellipsoid in the box was found"
    return Infeasible(
        f"{what}: one is found once disturbance and error radii shrink to {fraction:.1%} of those given",
        binding,
        1.0 - fraction,
        {"share_of_radii": fraction},
    )


def with_feasible_bounds(infeasible: Infeasible, plant: LinearPlant, contract: ChannelContract | None) -> Infeasible:
    """Returns the exception with the largest feasible age, and the largest feasible gamma at the contract's age.

    Args:
        infeasible: The exception without these figures.
        plant: The plant for which no certificate was found.
        contract: The channel contract; without one the exception is returned as it is.
    """
    if contract is None or infeasible.binding == "S":
        return infeasible
    hints, details = [str(infeasible)], dict(infeasible.details)
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
    return Infeasible(message, infeasible.binding, infeasible.shortfall, details)


def _is_feasible(plant: LinearPlant, contract: ChannelContract) -> bool:
    """Returns whether a gain is found that tolerates the plant's radii."""
    try:
        problem, _ = design_problem(plant, contract)
    except Infeasible:
        return False
    return _margin(problem) >= SUFFICIENT_MARGIN


def _largest_age(plant: LinearPlant, contract: ChannelContract) -> int | None:
    """Returns the largest feasible max_age below the contract's; None if there is none."""
    low, high = -1, contract.max_age
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _is_feasible(plant, replace(contract, max_age=middle)) else (low, middle)
    return low if low >= 0 else None


def _largest_gamma(plant: LinearPlant, contract: ChannelContract) -> float | None:
    """Returns nearly the largest feasible gamma below the plant's; None if there is none above a millionth of it."""
    low, high = _SMALLEST_GAMMA * plant.gamma, plant.gamma
    if not _is_feasible(replace(plant, gamma=low), contract):
        return None
    while high > _GAMMA_PRECISION * low:
        middle = (low * high) ** 0.5
        low, high = (middle, high) if _is_feasible(replace(plant, gamma=middle), contract) else (low, middle)
    return low


def _margin(problem: DesignProblem, *, input_limits: bool = True) -> float:
    """Returns the factor on all radii that the max-margin gain tolerates; 0 if no gain stabilizes."""
    gain = max_margin_gain(problem, problem.covering_error_shape, input_limits=input_limits)
    return 0.0 if gain is None else gain.margin
