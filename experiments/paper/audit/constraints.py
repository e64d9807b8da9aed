"""Rows about the plant and about OP's constraints at the printed K and M."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from experiments.paper.audit.claim import PRINTED_DIGITS, Claim, Defect, Verdict
from experiments.paper.paper_example import PaperExample
from shields.paper.bounds import safety_margin


def plant_claims(example: PaperExample) -> Iterator[Claim]:
    """Yields the rows about A, B and the contraction (C1)."""
    plant = example.plant
    gap = max(np.abs(plant.A - example.A).max(), np.abs(plant.B - example.B).max())
    yield Claim(
        "A and B discretize the spring-damper coupling with dt = 0.5 s",
        f"A = {example.A.tolist()}, B = {example.B.ravel().tolist()}",
        f"the exact zero-order hold differs by at most {gap:.1e}",
        Verdict.of(gap <= PRINTED_DIGITS),
    )
    kappa = _contraction(example.closed_loop, example.M)
    is_rounding = 0.0 < kappa - example.kappa <= 2 * PRINTED_DIGITS
    yield Claim(
        "(C1) the closed loop contracts by kappa",
        f"kappa = {example.kappa}",
        f"the largest eigenvalue of (A+BK)'M(A+BK) against M is {kappa:.5f}",
        Verdict.ROUNDED if is_rounding else Verdict.of(kappa <= example.kappa),
        "the excess is within a unit of the last printed digit" if is_rounding else "",
    )


def _contraction(closed_loop: np.ndarray, M: np.ndarray) -> float:
    """Returns the smallest kappa with (A+BK)'M(A+BK) <= kappa M."""
    root = np.linalg.cholesky(M)
    inner = np.linalg.solve(root, closed_loop.T @ M @ closed_loop)
    return float(np.linalg.eigvals(np.linalg.solve(root, inner.T).T).real.max())


def constraint_claims(example: PaperExample) -> Iterator[Claim]:
    """Yields the rows about the margin (C2), the safe box (C3) and the input limit (C5)."""
    yield _margin(example)
    plant, L = example.plant, example.L
    largest = max(float(row @ L @ row) for row in plant.C)
    rounded = max(float(row @ np.linalg.inv(example.M - PRINTED_DIGITS * np.eye(2)) @ row) for row in plant.C)
    is_rounding = 1.0 < largest <= rounded
    yield Claim(
        "(C3) the set lies in the safe box",
        "|x1| <= 2 m, |x2| <= 2 m/s",
        f"the largest c_j L c_j' is {largest:.6f}",
        Verdict.ROUNDED if is_rounding else Verdict.of(largest <= 1.0),
        f"M is printed to four digits: up to {rounded:.4f} is their rounding" if is_rounding else "",
    )
    effort = float((example.K @ L @ example.K.T).item())
    limit = float(plant.u_max[0])
    yield _limited(
        "(C5) half of the squared input limit covers K x",
        f"u_max^2 / 2 = {limit**2 / 2:g}",
        f"K L K' = {effort:.2f}",
        effort <= limit**2 / 2,
    )
    yield _limited(
        "the input stays within its limit on the set",
        f"|u| <= {limit:g}",
        f"the largest |K x| on the set is {effort**0.5:.2f}, without any estimation error",
        effort**0.5 <= limit,
    )


def _margin(example: PaperExample) -> Claim:
    gamma = example.plant.gamma
    alpha = safety_margin(gamma, example.epsilon, example.kappa)
    smallest = float(np.linalg.eigvalsh(example.L)[0])
    root = smallest**0.5 * (1.0 - example.kappa**0.5) - example.epsilon**0.5
    fails = smallest < alpha
    return Claim(
        "(C2) L >= alpha I, the margin for disturbance and error",
        f"gamma = {gamma:g}, epsilon = {example.epsilon}, kappa = {example.kappa}",
        f"alpha = {alpha:.3f}, but lambda_min(L) = {smallest:.3f}",
        Verdict.of(not fails),
        f"it would hold for gamma <= {max(root, 0.0) ** 2:.2g}, or with gamma in place of its square root (alpha = "
        f"{misread_alpha(example):.2f}), with which row 12 reproduces K and M",
        Defect.MARGIN if fails else "",
    )


def misread_alpha(example: PaperExample) -> float:
    """Returns the alpha of Definition 4 with gamma in place of its square root, at the printed epsilon and kappa."""
    return ((example.plant.gamma + example.epsilon**0.5) / (1.0 - example.kappa**0.5)) ** 2


def _limited(claim: str, printed: str, computed: str, holds: bool) -> Claim:
    """Returns a row about the input limit, which row 12 explains."""
    explained = "" if holds else "row 12 explains rows 5 and 6 together: K is OP's optimum for another limit"
    return Claim(claim, printed, computed, Verdict.of(holds), explained, "" if holds else Defect.INPUT_LIMIT)
