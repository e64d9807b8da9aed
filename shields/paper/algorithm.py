"""Algorithm 1 of Liu et al.: the search for a feasible point (kappa, rho) of OP, as printed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from ncs_gym import LinearPlant
from ncs_gym.validation import as_number
from shields.paper.bounds import SMALLEST_GAP, PaperModel
from shields.paper.optimization_problem import OPSolution, OptimizationProblem

# Relative tightening of every constraint, so that what the solver returns meets the printed ones in exact arithmetic.
_SLACK = 1e-7
# Relative slack that (C2) must have before the tightened problem is solved.
_REQUIRED_SLACK = 1e-6


def kappa_rho_grid(dkappa: float, drho: float) -> Iterator[tuple[float, float]]:
    """Yields (kappa, rho) in the order of Algorithm 1: kappa from 1 down by dkappa, rho from 1 up to 1/kappa by drho.

    Points with kappa rho = 1 are skipped: there the error bound is infinite.

    Raises:
        ValueError: If a step is not positive.
    """
    dkappa, drho = (as_number(v, name, low=0.0, low_open=True) for v, name in ((dkappa, "dkappa"), (drho, "drho")))
    kappa, i = 1.0, 0
    while kappa > SMALLEST_GAP:
        rho, j = 1.0, 0
        while kappa * rho <= 1.0 - SMALLEST_GAP:
            yield kappa, rho
            j += 1
            rho = 1.0 + j * drho
        i += 1
        kappa = 1.0 - i * dkappa


def search_grid(
    plant: LinearPlant,
    *,
    dkappa: float = 0.02,
    drho: float = 0.05,
    search: str = "first",
    accept: Callable[[OPSolution], bool] = lambda solution: True,
) -> OPSolution:
    """Returns the solution of OP that Algorithm 1 finds.

    Args:
        plant: The plant with its bounds.
        dkappa: Grid step of kappa, > 0.
        drho: Grid step of rho, > 0.
        search: "first" (as printed: the first feasible point) or "largest" (the largest log det L over the grid).
        accept: Returns whether a solution ends the search.

    Raises:
        LookupError: If OP has no accepted solution on the grid.
        ValueError: If a step is not positive or the search is unknown.
    """
    if search not in ("first", "largest"):
        raise ValueError(f"search must be 'first' or 'largest', got {search!r}")
    problem, model = OptimizationProblem(plant), PaperModel(plant)

    def solution_at(kappa: float, rho: float) -> OPSolution | None:
        bounds = model.at(kappa, rho)
        is_feasible = problem.largest_eigenvalue(bounds) >= bounds.alpha * (1.0 + _REQUIRED_SLACK)
        return problem.solution(bounds, slack=_SLACK) if is_feasible else None

    solutions = filter(None, (solution_at(*point) for point in kappa_rho_grid(dkappa, drho)))
    if search == "largest":
        solutions = sorted(solutions, key=lambda solution: solution.log_det, reverse=True)
    if (accepted := next(filter(accept, solutions), None)) is None:
        raise LookupError("OP has no solution on the grid")
    return accepted
