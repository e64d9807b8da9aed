"""The certificate that OP and Algorithm 1 of Liu et al. give, or the reason why there is none."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym import LinearPlant
from shields.errors import Infeasible
from shields.paper.algorithm import search_grid
from shields.paper.bounds import unknown_bounds
from shields.paper.certificate import PaperCertificate
from shields.paper.conditions import verify
from shields.paper.feasibility import FeasibilityScan, largest_gamma, largest_noise_scale, largest_scale
from shields.paper.optimization_problem import OPSolution


@np.errstate(all="ignore")
def synthesize(
    plant: LinearPlant, *, dkappa: float = 0.02, drho: float = 0.05, search: str = "first"
) -> PaperCertificate:
    """Returns the certificate of OP and Algorithm 1 (Liu et al. Definition 4), as printed.

    Args:
        plant: The plant with its bounds.
        dkappa: Grid step of kappa, > 0.
        drho: Grid step of rho, > 0.
        search: "first" feasible grid point, as printed, or "largest" volume over the grid.

    Raises:
        Infeasible: If OP has no solution on the grid that meets (C1)-(C7) exactly.
        ValueError: If an argument is out of range, or the plant has bounds that the paper's theorems do not know.
    """
    if not isinstance(plant, LinearPlant):
        raise ValueError(f"plant must be a LinearPlant, got {type(plant).__name__}")
    if unknown := unknown_bounds(plant):
        raise ValueError(
            f"the paper's method knows a Ball of disturbances and Gaussians alone, not {' and '.join(unknown)}: use "
            "shields.synthesize"
        )
    free = plant.n - int(np.linalg.matrix_rank(plant.box_rows))
    if free:
        raise Infeasible(f"the safe box leaves {free} of {plant.n} directions unbounded: limit them", "S", free)
    provenance = {"search": search, "dkappa": dkappa, "drho": drho}

    def meets_constraints(solution: OPSolution) -> bool:
        return verify(_certificate(plant, solution, provenance), plant).valid

    try:
        solution = search_grid(plant, dkappa=dkappa, drho=drho, search=search, accept=meets_constraints)
    except LookupError:
        raise _diagnosis(plant) from None
    return _certificate(plant, solution, provenance)


def _certificate(plant: LinearPlant, solution: OPSolution, provenance: dict[str, Any]) -> PaperCertificate:
    """Returns the certificate of a solution of OP, not yet verified."""
    bounds = solution.bounds
    return PaperCertificate(
        L=solution.L,
        K=solution.K,
        kappa=bounds.kappa,
        rho=bounds.rho,
        epsilon=bounds.epsilon,
        epsilon_up=bounds.epsilon_up,
        fingerprint=plant.fingerprint,
        provenance={"source": "Liu et al. Definition 4 and Algorithm 1", **provenance, "alpha": bounds.alpha},
    )


def _diagnosis(plant: LinearPlant) -> Infeasible:
    """Returns the exception that says which constraint binds, by how much, and what would be feasible."""
    scan = FeasibilityScan(plant)
    try:
        best = scan.best(plant)
    except LookupError as error:
        return Infeasible(f"OP is infeasible: {error}", "C1", np.inf)
    full = scan.full_ratio(plant) if best.ratio >= 1.0 else best.ratio
    if best.ratio >= 1.0 > full:
        return Infeasible(
            f"OP is infeasible, the input limit with the communication error (C4)-(C6) binds: with it the largest "
            f"lambda_min(L)/alpha found is {full:.3g} (without it {best.ratio:.3g}) and must be at least 1",
            "C5",
            1.0 - full,
        )
    if full >= 1.0:
        return Infeasible(
            f"OP has no solution on this grid, but has one near kappa = {best.kappa:.3f}, rho = {best.rho:.3f}: use "
            "smaller steps dkappa and drho",
            "grid",
            0.0,
        )
    gamma, noise, scale = largest_gamma(scan, plant), largest_noise_scale(scan, plant), largest_scale(scan, plant)
    return Infeasible(
        f"OP is infeasible, (C2) binds: over the whole domain the largest lambda_min(L)/alpha is {best.ratio:.3g} (at "
        f"kappa = {best.kappa:.3f}, rho = {best.rho:.3f}) and must be at least 1; it is feasible with "
        f"gamma, Q and P0 all scaled by {scale:.3g}. {_tolerated(gamma, noise)}",
        "C2",
        1.0 - best.ratio,
        {
            "ratio": best.ratio,
            "kappa": best.kappa,
            "rho": best.rho,
            "largest_gamma": gamma,
            "largest_noise_scale": noise,
            "largest_scale": scale,
        },
    )


def _tolerated(gamma: float, noise: float) -> str:
    by_gamma = f"enough to lower gamma to {gamma:.3g}" if gamma > 0.0 else "not enough to lower gamma, even to 0"
    by_noise = f"enough to scale Q by {noise:.3g}" if noise > 0.0 else "not enough to lower Q, even to 0"
    return f"With Q unchanged it is {by_gamma}; with gamma unchanged it is {by_noise}"
