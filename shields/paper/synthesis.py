"""Algorithm 1 of Liu et al. and the certificate that it gives."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.validation import as_number
from shields.errors import Infeasible
from shields.paper.bounds import SMALLEST_GAP, PaperModel, unknown_bounds
from shields.paper.certificate import PaperCertificate, verify
from shields.paper.optimization_problem import OPSolution, OptimizationProblem

# Relative tightening of every constraint, so that what the solver returns meets the printed ones in exact arithmetic.
_SLACK = 1e-7
# Relative slack that (C2) must have before the tightened problem is solved.
_REQUIRED_SLACK = 1e-6


@np.errstate(all="ignore")
def synthesize(plant: LinearPlant, *, dkappa: float = 0.02, drho: float = 0.05) -> PaperCertificate:
    """Returns the certificate of OP and Algorithm 1 (Liu et al. Definition 4), as printed: the first feasible point.

    Args:
        plant: The plant with its bounds.
        dkappa: Grid step of kappa, > 0.
        drho: Grid step of rho, > 0.

    Raises:
        Infeasible: If OP has no solution on the grid that meets (C1)-(C7) exactly.
        ValueError: If an argument is out of range, or the plant has bounds that the paper's theorems do not know.
    """
    if not isinstance(plant, LinearPlant):
        raise ValueError(f"plant must be a LinearPlant, got {type(plant).__name__}")
    if unknown := unknown_bounds(plant):
        raise ValueError(
            "the paper's method knows a Ball of disturbances and Gaussians alone, not "
            f"{' and '.join(unknown)}: use shields.synthesize"
        )
    free = plant.n - int(np.linalg.matrix_rank(plant.box))
    if free:
        raise Infeasible(f"the safe box leaves {free} of {plant.n} directions unbounded: limit them", "S", free)
    for solution in grid_solutions(plant, dkappa, drho):
        bounds = solution.bounds
        certificate = PaperCertificate(
            L=solution.L,
            K=solution.K,
            kappa=bounds.kappa,
            rho=bounds.rho,
            epsilon=bounds.epsilon,
            epsilon_up=bounds.epsilon_up,
            fingerprint=plant.fingerprint,
            provenance={"source": "Liu et al. Definition 4 and Algorithm 1", "dkappa": dkappa, "drho": drho},
        )
        if verify(certificate, plant).valid:
            return certificate
    raise Infeasible(
        "OP has no solution on this grid that meets (C1)-(C7): take smaller steps dkappa and drho, or smaller bounds",
        "OP",
        1.0,
    )


def grid_solutions(plant: LinearPlant, dkappa: float = 0.02, drho: float = 0.05) -> Iterator[OPSolution]:
    """Yields the solutions of OP on the grid of Algorithm 1, in its order.

    Raises:
        ValueError: If a step is not positive.
    """
    problem, model = OptimizationProblem(plant), PaperModel(plant)
    for point in kappa_rho_grid(dkappa, drho):
        bounds = model.at(*point)
        if problem.largest_eigenvalue(bounds) >= bounds.alpha * (1.0 + _REQUIRED_SLACK):
            solution = problem.solution(bounds, slack=_SLACK)
            if solution is not None:
                yield solution


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
