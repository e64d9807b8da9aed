"""Rows about epsilon and the largest simulated error."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from experiments.paper.audit.claim import Claim, Defect, Verdict
from experiments.paper.paper_example import PaperExample
from ncs_gym import LinearPlant
from shields.paper.bounds import PaperModel, uplink_error_bound


def error_claims(example: PaperExample) -> Iterator[Claim]:
    """Yields the rows about the error bound, and about the error of the simulation."""
    plant = example.plant
    least = PaperModel(plant).at(example.kappa, 1.0)
    norm = float(np.linalg.norm(example.B @ example.K, 2))
    condition = float(np.linalg.cond(example.L))
    tight = [norm**2 * _uplink(plant, g2) for g2 in (example.kappa, example.kappa * condition)]
    fails = least.epsilon > example.epsilon
    yield Claim(
        "epsilon is the bound of Theorems 2 and 3 at the printed P0, Q, gamma and delta",
        f"epsilon = {example.epsilon}",
        f"with g_bar^2 = kappa rho >= {example.kappa} the theorems give epsilon >= {least.epsilon:.3f}",
        Verdict.of(not fails),
        f"with the actual |BK| = {norm:.3f} in place of Theorem 3's bound on it: {tight[0]:.4f} for g_bar^2 = kappa, "
        f"{tight[1]:.4f} for kappa cond(L), so the printed epsilon is a valid bound once K is known",
        Defect.EPSILON if fails else "",
    )
    needed = example.largest_error / norm**2
    implied = example.epsilon * least.epsilon_up / least.epsilon
    read_otherwise = example.epsilon / norm**2
    yield Claim(
        "the largest simulated error agrees with the bounds",
        f"max e'e = {example.largest_error} < epsilon = {example.epsilon}",
        f"it needs e_up'e_up >= {needed:.4f}; the printed epsilon implies at most {implied:.4f} through Theorem 3, but "
        f"up to {read_otherwise:.3f} under the reading of row 9, with the actual |BK|",
        Verdict.HOLDS if needed <= implied else Verdict.UNDECIDED if needed <= read_otherwise else Verdict.FAILS,
        f"no contradiction under either reading if {example.largest_error} is a norm, not its square (then "
        f"e_up'e_up >= {example.largest_error**2 / norm**2:.2g})",
        Defect.EPSILON if needed > read_otherwise else "",
    )


def _uplink(plant: LinearPlant, g2: float) -> float:
    return uplink_error_bound(plant.gamma, plant.process_noise_cov, plant.initial_cov, plant.delta, g2)
