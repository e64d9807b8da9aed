"""The certificate of the published method, or the reason why there is none."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.paper.algorithm import search_grid
from shields.paper.bounds import unknown_bounds
from shields.paper.conditions import paper_conditions
from shields.paper.feasibility import FeasibilityScan, largest_gamma, largest_noise_scale, largest_scale
from shields.paper.optimization_problem import OPSolution


def paper_certificate(plant: LinearPlant, *, dkappa: float, drho: float, search: str) -> Certificate:
    """Returns the certificate of OP and Algorithm 1 (Liu et al. Definition 4), as printed.

    It carries the guarantee of the paper's own definitions, which assumes e'e <= eps. It has no error set, so a shield
    with this certificate is never guaranteed.

    Args:
        plant: The plant with its bounds.
        dkappa: Grid step of kappa, > 0.
        drho: Grid step of rho, > 0.
        search: "first" or "largest".

    Raises:
        Infeasible: If OP has no solution on the grid that meets (C1)-(C7) exactly.
        ValueError: If an argument is out of range, or the plant has bounds that the paper's theorems do not know.
    """
    if unknown := unknown_bounds(plant):
        raise ValueError(
            f"method 'paper' knows gamma and covariances alone, not {' and '.join(unknown)}: use method 'certified'"
        )
    free = plant.n - int(np.linalg.matrix_rank(plant.box_rows))
    if free:
        raise Infeasible(f"the safe box leaves {free} of {plant.n} directions unbounded: add rows to box", "S", free)
    provenance = {"search": search, "dkappa": dkappa, "drho": drho}

    def meets_constraints(solution: OPSolution) -> bool:
        conditions = paper_conditions(_certificate(plant, solution, provenance), plant)
        return all(condition.holds for condition in conditions)

    try:
        solution = search_grid(plant, dkappa=dkappa, drho=drho, search=search, accept=meets_constraints)
    except LookupError:
        raise _diagnosis(plant) from None
    return _certificate(plant, solution, provenance)


def _certificate(plant: LinearPlant, solution: OPSolution, provenance: dict[str, Any]) -> Certificate:
    """Returns the certificate of a solution of OP, not yet verified."""
    return Certificate(
        L=solution.L,
        K=solution.K,
        method="paper",
        fingerprint=plant.fingerprint,
        kappa=solution.bounds.kappa,
        rho=solution.bounds.rho,
        epsilon=solution.bounds.epsilon,
        epsilon_up=solution.bounds.epsilon_up,
        provenance={
            "source": "Liu et al. Definition 4 and Algorithm 1",
            **provenance,
            "alpha": solution.bounds.alpha,
            "guarantee": "the paper's own: invariance if e'e <= epsilon at every step",
        },
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
