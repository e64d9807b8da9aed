"""Why no certificate was found, and by how much."""

from __future__ import annotations

from dataclasses import replace

from ncs_gym import ChannelContract, LinearPlant
from shields.design_problem import design_problem
from shields.gain_search import roomiest_gain
from shields.infeasible import Infeasible
from shields.semidefinite import InvariantSetProgram, ScaledProblem
from shields.starts import best_start

# Room of the trial programs.
SLACK = 1e-6


def with_largest_age(reason: Infeasible, plant: LinearPlant, contract: ChannelContract | None) -> Infeasible:
    """Returns the exception with the largest age for which a start is found, under a contract of some age."""
    if contract is None or contract.max_age == 0 or reason.binding == "S":
        return reason

    def works(age: int) -> bool:
        try:
            problem, _ = design_problem(plant, replace(contract, max_age=age))
        except Infeasible:
            return False
        return _has_start(problem)

    low, high = -1, contract.max_age
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if works(middle) else (low, middle)
    hint = f"max_age = {low} is the largest that works" if low >= 0 else "no smaller max_age works either"
    details = reason.details | ({"max_age": low} if low >= 0 else {})
    return Infeasible(f"{reason}; {hint} (asked: {contract.max_age})", reason.binding, reason.shortfall, details)


def diagnosis(problem: ScaledProblem) -> Infeasible:
    """Returns the exception that says what binds, and the share of the radii that a design was found for."""
    share = next((scale for scale in _promising(problem) if _has_start(problem, scale)), 0.0)
    unlimited = roomiest_gain(problem, problem.Sigmas[-1], limited=False)
    binding = "U" if unlimited is not None and unlimited.reach >= 1.0 else "I"
    what = "(U) the input limits are too tight" if binding == "U" else "(I) no invariant ellipsoid in the box was found"
    return Infeasible(
        f"{what}: one is found once disturbance and error radii shrink to {share:.1%} of those given",
        binding,
        1.0 - share,
        {"share_of_radii": share},
    )


def _promising(problem: ScaledProblem) -> list[float]:
    """Returns shares of the radii, below 1 and falling, at which a design may be found."""
    gain = roomiest_gain(problem, problem.Sigmas[-1])
    reach = 1.0 if gain is None else min(gain.reach, 1.0)
    return [reach * factor for factor in (0.999, 0.99, 0.97, 0.93, 0.85, 0.7, 0.5, 0.3, 0.1, 0.01)]


def _has_start(problem: ScaledProblem, scale: float = 1.0) -> bool:
    """Returns whether a design is found for radii of disturbance and error sets scaled by `scale`."""
    scaled = replace(problem, D=scale**2 * problem.D, Sigmas=scale**2 * problem.Sigmas)
    return best_start(scaled, InvariantSetProgram(scaled, SLACK), lambda line: None) is not None
