"""The multipliers that prove a given set and gain best, which minimize convex functions of one or two numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from shields.synthesis.design_problem import CandidateDesign, DesignProblem

# Digits of the logarithms of ratios of multipliers: a search ends at the same ones on every processor.
LOGARITHM_DIGITS = 9


def best_multipliers(
    problem: DesignProblem, error_shapes: np.ndarray, L: np.ndarray, K: np.ndarray, initial: tuple[float, float, float]
) -> tuple[tuple[float, float, float], float]:
    """Returns the multipliers (lx, le, ld) of (I), and the largest eigenvalue of the successors' shape against L.

    The successors' shape is matrix-convex in the multipliers, so its largest generalized eigenvalue, over all error
    sets, is a convex function of two numbers. (I) holds if it is at most 1.

    Args:
        problem: The scaled design problem.
        error_shapes: Shapes of the error sets, scaled, (k, n, n).
        L: Shape of the set, scaled, (n, n).
        K: Gain, scaled, shape (m, n).
        initial: Where the minimization starts.
    """
    inverse_factor = np.linalg.inv(np.linalg.cholesky(L))
    # Shapes of what state, errors and disturbance each add to the successors, in coordinates in which E(L) is a ball.
    closed_loop, from_errors = inverse_factor @ (problem.A + problem.B @ K), inverse_factor @ problem.B @ K
    state_shape = closed_loop @ L @ closed_loop.T
    moved_error_shapes = from_errors @ error_shapes @ from_errors.T
    disturbance_shape = inverse_factor @ problem.D_u @ inverse_factor.T

    def multipliers_of(logits: np.ndarray) -> np.ndarray:
        weights = np.exp(np.clip(np.append(logits, 0.0), -30.0, 30.0))
        return weights / weights.sum()

    def largest_eigenvalue(logits: np.ndarray) -> float:
        lx, le, ld = multipliers_of(logits)
        successors = state_shape / lx + moved_error_shapes / le + disturbance_shape / ld
        return float(np.linalg.eigvalsh(successors)[:, -1].max())

    logits = np.log(np.array(initial[:2]) / initial[2])
    # What is compared differs by much more than rounding: all processors go the same way.
    options = {"xatol": 1e-5, "fatol": 1e-10, "maxiter": 400}
    minimum = minimize(largest_eigenvalue, logits, method="Nelder-Mead", options=options)
    lx, le, ld = multipliers_of(np.round(minimum.x, LOGARITHM_DIGITS))
    return (float(lx), float(le), float(ld)), float(minimum.fun)


def best_input_multipliers(error_shapes: np.ndarray, L: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Returns the multipliers mu_i of (U), shape (m,): the fraction of the largest input that is due to the state.

    mu_i = a / (a + b), a = sqrt(K_i L K_i') due to the state, b = max sqrt(K_i Sigma K_i') due to the error, scaled.
    """
    by_state = np.sqrt(np.maximum(((K @ L) * K).sum(axis=1), 0.0))
    by_error = np.sqrt(np.maximum(((K @ error_shapes) * K).sum(axis=-1), 0.0)).max(axis=0)
    return np.clip(np.round(by_state / np.maximum(by_state + by_error, 1e-300), 6), 1e-6, 1.0 - 1e-6)


def with_best_multipliers(problem: DesignProblem, design: CandidateDesign, error_shapes: np.ndarray) -> CandidateDesign:
    """Returns a design with the multipliers that suit the error sets of the given shapes (k, n, n) best."""
    multipliers, _ = best_multipliers(problem, error_shapes, design.L, design.K, design.multipliers)
    inputs = best_input_multipliers(error_shapes, design.L, design.K)
    return replace(design, multipliers=multipliers, inputs=inputs)
