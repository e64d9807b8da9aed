"""The row about the feasibility of OP at the printed parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.paper.audit.claim import Claim, Defect, Verdict
from experiments.paper.paper_example import PaperExample
from ncs_gym import LinearPlant
from ncs_gym.uncertainty.truncated_gaussian import truncation_energy
from shields.paper.bounds import PaperModel
from shields.paper.feasibility import FeasibilityScan, largest_gamma, largest_scale


def feasibility_claim(example: PaperExample) -> Claim:
    """Returns the row about OP as printed, and under the most charitable readings of its bounds."""
    plant = example.plant
    scan = FeasibilityScan(plant)
    best = scan.best(plant)
    fails = best.ratio < 1.0
    still = scan.best(replace(plant, gamma=0.0))
    gamma = largest_gamma(scan, replace(plant, process_noise_cov=np.zeros((2, 2))))
    return Claim(
        "OP is feasible at the printed parameters",
        "Algorithm 1 returned K and M",
        f"{'in' * fails}feasible under the theorem as printed: over all (kappa, rho) the largest lambda_min(L)/alpha "
        f"is {best.ratio:.3f} (kappa = {best.kappa:.3f}, rho = {best.rho:.3f}), at least 1 is needed; with gamma = 0 "
        f"it is {still.ratio:.2f}. OP is feasible with gamma, Q and P0 all scaled by {largest_scale(scan, plant):.3f}; "
        f"with Q = 0 for gamma <= {gamma:.2g}, a disturbance radius of {gamma**0.5:.4f} against {plant.gamma**0.5:.4f}",
        Verdict.of(not fails),
        _charitable(plant, scan),
        Defect.MARGIN if fails else "",
    )


def _charitable(plant: LinearPlant, scan: FeasibilityScan) -> str:
    """Returns what other readings of the bounds give."""
    tail = truncation_energy(1.0 - plant.delta, plant.n)
    model = PaperModel(plant, quantile=tail)
    best = scan.best(plant, model)
    is_feasible = scan.full_ratio(plant, model) >= 1.0
    epsilon = model.at(best.kappa, best.rho).epsilon
    q_bar = float(np.linalg.eigvalsh(plant.process_noise_cov)[-1])
    without = scan.best(plant, PaperModel(plant, q_bar=q_bar, quantile=1.0))
    return (
        f"with the tail taken at delta instead of 1 - delta (chi2 = {tail:.3f} instead of "
        f"{plant.process_noise.energy:.2f}), the ratio is {best.ratio:.2f} (kappa = {best.kappa:.2f}, rho = "
        f"{best.rho:.3f}) and OP is {'' if is_feasible else 'not '}feasible, though with epsilon = {epsilon:.4f} and "
        f"another K; with q_bar = lambda_max(Q) and no chi-square factor the ratio is {without.ratio:.2f}"
    )
