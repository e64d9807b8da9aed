"""Why no certificate was found, and by how much."""

from __future__ import annotations

from dataclasses import replace

from ncs_gym import ChannelContract, LinearPlant
from shields.design_problem import design_problem
from shields.infeasible import Infeasible
from shields.semidefinite import InvariantSetProgram, ScaledProblem
from shields.starts import grown_start, nominal_start, plain_start

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
        program = InvariantSetProgram(problem, SLACK)
        starts = (start(problem, program, lambda line: None) for start in (nominal_start, plain_start))
        return any(design is not None for design in starts)

    low, high = -1, contract.max_age
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if works(middle) else (low, middle)
    hint = f"max_age = {low} is the largest that works" if low >= 0 else "no smaller max_age works either"
    details = reason.details | ({"max_age": low} if low >= 0 else {})
    return Infeasible(f"{reason}; {hint} (asked: {contract.max_age})", reason.binding, reason.shortfall, details)


def diagnosis(problem: ScaledProblem) -> Infeasible:
    """Returns the exception that says what binds, from feasibility at reduced uncertainty and without input limits."""

    def feasible(scale: float, *, limited: bool = True) -> bool:
        trial = replace(problem, D=scale**2 * problem.D, Sigmas=scale**2 * problem.Sigmas)
        program = InvariantSetProgram(trial, SLACK, limited=limited)
        found = plain_start(trial, program, silent)
        return found is not None or (not limited and nominal_start(trial, program, silent) is not None)

    def silent(line: str) -> None:
        pass

    design, low = grown_start(problem, InvariantSetProgram(problem, SLACK), silent)
    low, high = (low, 1.0) if design is not None else (0.0, 1.0)
    for _ in range(7 if low == 0.0 else 0):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if feasible(middle) else (low, middle)
    binding = "U" if feasible(1.0, limited=False) else "I"
    what = "(U) the input limits are too tight" if binding == "U" else "(I) no invariant ellipsoid in the box was found"
    return Infeasible(
        f"{what}: one is found once disturbance and error radii shrink to {low:.1%} of those given",
        binding,
        1.0 - low,
    )
