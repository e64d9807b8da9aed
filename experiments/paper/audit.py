"""Checks what Section 5 of Liu et al. prints, claim by claim; docs/paper.md discusses the outcome."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from experiments.paper.counterexample import OneStep, stays_inside, worst_step
from experiments.paper.paper_example import PaperExample
from shields.paper.bounds import PaperModel, safety_margin, uplink_error_bound
from shields.paper.feasibility import FeasibilityScan, largest_gamma, largest_scale

HOLDS, ROUNDED, FAILS, UNDECIDED = "holds", "holds, rounded", "does not hold", "undecided"
# Agreement within the last printed digit of a four-digit number.
_PRINTED_DIGITS = 5e-5


@dataclass(frozen=True)
class Claim:
    """One claim of the paper and its verdict.

    Attributes:
        claim: What the paper says.
        printed: The number that the paper prints.
        computed: What follows from the paper's own numbers.
        verdict: "holds", "holds, rounded" (but for the rounding of printed numbers), "does not hold" or "undecided".
        charitable: Under which other reading it would hold, or how near it comes; empty if there is none.
    """

    claim: str
    printed: str
    computed: str
    verdict: str
    charitable: str = ""


def audited_claims(example: PaperExample) -> Iterator[Claim]:
    """Yields the claims of Section 5, all computed from the printed numbers."""
    yield from _plant_claims(example)
    yield from _constraint_claims(example)
    yield from _invariance_claims(example)
    yield from _error_claims(example)
    yield _feasibility_claim(example)


def _plant_claims(example: PaperExample) -> Iterator[Claim]:
    plant = example.plant
    gap = max(np.abs(plant.A - example.A).max(), np.abs(plant.B - example.B).max())
    yield Claim(
        "A and B discretize the spring-damper coupling with dt = 0.5 s",
        f"A = {example.A.tolist()}, B = {example.B.ravel().tolist()}",
        f"the exact zero-order hold differs by at most {gap:.1e}",
        _verdict(gap <= _PRINTED_DIGITS),
    )
    root = np.linalg.cholesky(example.M)
    inner = np.linalg.solve(root, example.closed_loop.T @ example.M @ example.closed_loop)
    kappa = float(np.linalg.eigvals(np.linalg.solve(root, inner.T).T).real.max())
    yield Claim(
        "(C1) the closed loop contracts by kappa",
        f"kappa = {example.kappa}",
        f"the largest eigenvalue of (A+BK)'M(A+BK) against M is {kappa:.5f}",
        HOLDS if kappa <= example.kappa else ROUNDED if kappa - example.kappa <= 2 * _PRINTED_DIGITS else FAILS,
        "the excess is within a unit of the last printed digit"
        if 0.0 < kappa - example.kappa <= 2 * _PRINTED_DIGITS
        else "",
    )


def _constraint_claims(example: PaperExample) -> Iterator[Claim]:
    plant, L = example.plant, example.L
    alpha = safety_margin(plant.gamma, example.epsilon, example.kappa)
    smallest = float(np.linalg.eigvalsh(L)[0])
    root = smallest**0.5 * (1.0 - example.kappa**0.5) - example.epsilon**0.5
    squared = ((plant.gamma + example.epsilon**0.5) / (1.0 - example.kappa**0.5)) ** 2
    yield Claim(
        "(C2) L >= alpha I, the margin for disturbance and error",
        f"gamma = {plant.gamma:g}, epsilon = {example.epsilon}, kappa = {example.kappa}",
        f"alpha = {alpha:.3f}, but lambda_min(L) = {smallest:.3f}",
        _verdict(smallest >= alpha),
        f"it would hold for gamma <= {max(root, 0.0) ** 2:.2g}, or with gamma in place of its square root (alpha = "
        f"{squared:.2f})",
    )
    largest = max(float(row @ L @ row) for row in plant.C)
    rounded = max(float(row @ np.linalg.inv(example.M - _PRINTED_DIGITS * np.eye(2)) @ row) for row in plant.C)
    yield Claim(
        "(C3) the set lies in the safe box",
        "|x1| <= 2 m, |x2| <= 2 m/s",
        f"the largest c_j L c_j' is {largest:.6f}",
        HOLDS if largest <= 1.0 else ROUNDED if largest <= rounded else FAILS,
        f"M is printed to four digits: up to {rounded:.4f} is their rounding" if 1.0 < largest <= rounded else "",
    )
    effort = float((example.K @ L @ example.K.T).item())
    limit = float(plant.u_max[0])
    yield Claim(
        "(C5) half of the squared input limit covers K x",
        f"u_max^2 / 2 = {limit**2 / 2:g}",
        f"K L K' = {effort:.2f}",
        _verdict(effort <= limit**2 / 2),
    )
    yield Claim(
        "the input stays within its limit on the set",
        f"|u| <= {limit:g}",
        f"the largest |K x| on the set is {effort**0.5:.2f}, without any estimation error",
        _verdict(effort**0.5 <= limit),
    )


def _invariance_claims(example: PaperExample) -> Iterator[Claim]:
    gamma = example.plant.gamma
    every = worst_step(example.closed_loop, example.M, gamma, example.epsilon)
    outside = every.level > 1.0
    yield Claim(
        "the set is (gamma, epsilon)-RSI (Definition 1): every e with e'e <= epsilon",
        "x+ in S for all x in S, d, e",
        f"worst x+'M x+ = {every.level:.4f}" + (f"; {_example(every)}" if outside else ""),
        FAILS
        if every.confirmed
        else (HOLDS if stays_inside(example.closed_loop, example.M, gamma, example.epsilon) else UNDECIDED),
        "the next claim reads Definition 1 with the errors that can occur" if outside else "",
    )
    reachable = worst_step(example.closed_loop, example.M, gamma, example.epsilon, example.B[:, 0])
    proved = stays_inside(example.closed_loop, example.M, gamma, example.epsilon, example.B[:, 0])
    yield Claim(
        "the same for the errors that can occur: e = B K e_up lies in the range of B",
        "x+ in S for all x in S, d, e",
        f"worst x+'M x+ = {reachable.level:.3f}, if the input is not limited"
        + (" (that it stays inside is proved in exact arithmetic)" if proved else ""),
        FAILS if reachable.confirmed else (HOLDS if proved else UNDECIDED),
    )


def _error_claims(example: PaperExample) -> Iterator[Claim]:
    plant = example.plant
    least = PaperModel(plant).at(example.kappa, 1.0)
    norm = float(np.linalg.norm(example.B @ example.K, 2))
    condition = float(np.linalg.cond(example.L))
    tight = [norm**2 * _uplink(plant, g2) for g2 in (example.kappa, example.kappa * condition)]
    yield Claim(
        "epsilon is the bound of Theorems 5 and 7 at the printed P0, Q, gamma and delta",
        f"epsilon = {example.epsilon}",
        f"with g_bar^2 = kappa rho >= {example.kappa} the theorems give epsilon >= {least.epsilon:.3f}",
        _verdict(least.epsilon <= example.epsilon),
        f"with the actual |BK| = {norm:.3f} in place of Theorem 7's bound on it: {tight[0]:.4f} to {tight[1]:.4f}, so "
        "the printed epsilon is a valid bound once K is known",
    )
    needed = example.largest_error / norm**2
    implied = example.epsilon * least.epsilon_up / least.epsilon
    yield Claim(
        "the largest simulated error agrees with the bounds",
        f"max e'e = {example.largest_error} < epsilon = {example.epsilon}",
        f"it needs e_up'e_up >= {needed:.4f}; the printed epsilon implies at most {implied:.4f} through Theorem 7",
        _verdict(needed <= implied),
        f"no contradiction if {example.largest_error} is a norm, not its square (then e_up'e_up >= "
        f"{example.largest_error**2 / norm**2:.2g})",
    )


def _feasibility_claim(example: PaperExample) -> Claim:
    plant = example.plant
    scan = FeasibilityScan(plant)
    best = scan.best(plant)
    still = scan.best(replace(plant, gamma=0.0))
    quiet = replace(plant, process_noise_cov=np.zeros((2, 2)))
    gamma = largest_gamma(scan, quiet)
    charitable = scan.best(plant, PaperModel(plant, charitable=True))
    return Claim(
        "OP is feasible at the printed parameters",
        "Algorithm 1 returned K and M",
        f"over all (kappa, rho) the largest lambda_min(L)/alpha is {best.ratio:.3f} (kappa = {best.kappa:.3f}, rho = "
        f"{best.rho:.3f}), at least 1 is needed; with gamma = 0 it is {still.ratio:.2f}. OP is feasible with gamma, "
        f"Q and P0 all scaled by {largest_scale(scan, plant):.3f}; with Q = 0 for gamma <= {gamma:.2g}, a disturbance "
        f"radius of {gamma**0.5:.4f} against {plant.gamma**0.5:.4f}",
        _verdict(best.ratio >= 1.0),
        f"with q_bar = lambda_max(Q) and no chi-square factor the ratio is {charitable.ratio:.2f}",
    )


def _uplink(plant, g2: float) -> float:
    return uplink_error_bound(plant.gamma, plant.process_noise_cov, plant.initial_cov, plant.delta, g2)


def _example(step: OneStep) -> str:
    x, d, e, end = (np.round(v, 4).tolist() for v in (step.state, step.disturbance, step.error, step.following))
    confirmed = "confirmed in exact arithmetic" if step.confirmed else "not confirmed exactly"
    return f"for example x = {x}, d = {d}, e = {e} go to x+ = {end} ({confirmed})"


def _verdict(holds: bool) -> str:
    return HOLDS if holds else FAILS
