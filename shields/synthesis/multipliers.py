"""The shares that prove a given set and gain best: no program, convex functions of one or two numbers."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from shields.certificate import Multipliers
from shields.synthesis.semidefinite_programs import Design, ScaledProblem


def best_shares(
    problem: ScaledProblem, Sigmas: np.ndarray, L: np.ndarray, K: np.ndarray, start: tuple[float, float, float]
) -> tuple[tuple[float, float, float], float]:
    """Returns shares (lx, le, ld), and the largest generalized eigenvalue of (I)'s right side against L.

    The right side is matrix-convex in the shares, so its largest eigenvalue is a convex function of two numbers, and
    so is the largest over several error sets, shape (k, n, n).
    """
    root = np.linalg.inv(np.linalg.cholesky(L))
    closed, gain = root @ (problem.A + problem.B @ K), root @ problem.B @ K
    moved, spread = closed @ L @ closed.T, root @ problem.D @ root.T
    errors = gain @ Sigmas @ gain.T

    def shares_of(logits: np.ndarray) -> np.ndarray:
        weights = np.exp(np.clip(np.append(logits, 0.0), -30.0, 30.0))
        return weights / weights.sum()

    def worst(logits: np.ndarray) -> float:
        lx, le, ld = shares_of(logits)
        return float(np.linalg.eigvalsh(moved / lx + errors / le + spread / ld)[:, -1].max())

    logits = np.log(np.array(start[:2]) / start[2])
    found = minimize(worst, logits, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-12, "maxiter": 400})
    lx, le, ld = shares_of(found.x)
    return (float(lx), float(le), float(ld)), float(found.fun)


def best_input_shares(Sigmas: np.ndarray, L: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Returns mu_i = a / (a + b), a = sqrt(K_i L K_i'), b = max sqrt(K_i Sigma K_i'), shape (m,), inside (0, 1)."""
    a = np.sqrt(np.maximum(((K @ L) * K).sum(axis=1), 0.0))
    b = np.sqrt(np.maximum(((K @ Sigmas) * K).sum(axis=-1), 0.0)).max(axis=0)
    return np.clip(a / np.maximum(a + b, 1e-300), 1e-6, 1.0 - 1e-6)


def as_multipliers(problem: ScaledProblem, design: Design, rate: float) -> Multipliers:
    """Returns the design's multipliers, scaled so that rounding cannot lift lx + le + ld above 1."""
    lx, le, ld = rounded_down(design.shares)
    inputs = tuple(float(mu) for mu in design.inputs)
    return Multipliers(error=rate, state=lx, estimate=le, disturbance=ld, inputs=inputs, rounding=problem.growth)


def rounded_down(shares: tuple[float, float, float]) -> tuple[float, ...]:
    """Returns shares so much smaller that rounding cannot lift their sum above 1."""
    return tuple(share * (1.0 - 1e-15) for share in shares)
