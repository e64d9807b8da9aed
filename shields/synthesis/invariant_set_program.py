"""The certified method's linear matrix inequalities for fixed multipliers, and the multipliers that prove a set best.

The latter minimize convex functions of one or two numbers (docs/shield_proof.md).
"""

from __future__ import annotations

from dataclasses import replace

import cvxpy as cp
import numpy as np
from scipy.optimize import minimize

from shields.synthesis.design_problem import CandidateDesign, DesignProblem
from shields.synthesis.semidefinite_programs import is_solved, value_of
from shields.verification import ACTION_ROUNDING

# Digits of the logarithms of ratios of multipliers: a search ends at the same ones on every processor.
LOGARITHM_DIGITS = 9


class InvariantSetProgram:
    """Maximizes log det L over (L, K) for fixed multipliers, with X <= L Sigma^-1 L linearized at a given L0.

    With F = K L, S >= F L^-1 F' and T_j >= F G_j (le X_j)^-1 G_j' F' for every error set E(G_j G_j'), X_j being
    G_j' L Sigma_j^-1 L G_j, the conditions of docs/shield_proof.md are linear in (L, F, S, T_j) for fixed multipliers:

        (I)  L - D_u/ld - (A L A' + A F' B' + B F A' + B S B')/lx - B T_j B' >= 0
        (U)  S_ii/mu_i + le T_j,ii/(1 - mu_i) <= 1

    So only matrices of n and of n + m rows have to be positive semidefinite, whatever the number of inputs. Inputs are
    counted in units in which no column of B is longer than 1: limits so wide that they hardly count would spoil the
    solver's accuracy. The program is canonicalized once; multipliers and linearization are its parameters.

    Args:
        problem: The scaled design problem.
        slack: Relative tightening of the conditions, which exact verification needs: the disturbance and error sets
            are enlarged and the limits reduced by this fraction.
    """

    def __init__(self, problem: DesignProblem, slack: float) -> None:
        n, m = problem.B.shape
        self._problem, self._slack = problem, slack
        self._error_factors = list(np.linalg.cholesky((1.0 + slack) * problem.maximal_error_shapes))
        self._unit = 1.0 / np.maximum(np.linalg.norm(problem.B, axis=0), 1.0)
        self._L, self._F = cp.Variable((n, n), symmetric=True), cp.Variable((m, n))
        self._S = cp.Variable((m, m), symmetric=True)
        self._D_u = cp.Parameter((n, n), symmetric=True)
        self._by_state = cp.Parameter(nonneg=True)
        self._by_mu, self._by_rest = cp.Parameter(m, nonneg=True), cp.Parameter(m, nonneg=True)
        # Slope and offset of le X in coordinates in which Sigma is the identity (a small Sigma would spoil the solver's
        # accuracy).
        self._slopes = [cp.Parameter((n, n)) for _ in self._error_factors]
        self._offsets = [cp.Parameter((n, n), symmetric=True) for _ in self._error_factors]
        self._program = cp.Problem(cp.Maximize(cp.log_det(self._L)), self._constraints())

    def _constraints(self) -> list[cp.Constraint]:
        """Returns (S), and (I) and (U) for every maximal error set, as linear matrix inequalities."""
        A, B, L, F, S = self._problem.A, self._problem.B * self._unit, self._L, self._F, self._S
        cross = A @ F.T @ B.T
        kept = L - self._D_u - self._by_state * (A @ L @ A.T + cross + cross.T + B @ S @ B.T)
        limit = 1.0 - self._slack - 2.0 * float(ACTION_ROUNDING)
        constraints: list[cp.Constraint] = [
            cp.diag(self._problem.C @ L @ self._problem.C.T) <= 1.0 - self._slack,
            cp.bmat([[S, F], [F.T, L]]) >> 0,
        ]
        for G, slope, offset in zip(self._error_factors, self._slopes, self._offsets, strict=True):
            T = cp.Variable(S.shape, symmetric=True)
            X = G.T @ L @ slope + slope.T @ L @ G - offset
            constraints += [
                cp.bmat([[T, F @ G], [(F @ G).T, X]]) >> 0,
                kept - B @ T @ B.T >> 0,
                cp.multiply(self._by_mu, cp.diag(S)) + cp.multiply(self._by_rest, cp.diag(T)) <= limit,
            ]
        return constraints

    def solve(
        self, multipliers: tuple[float, float, float], inputs: np.ndarray, linearize_at: np.ndarray
    ) -> CandidateDesign | None:
        """Returns the design of largest volume for multipliers (lx, le, ld) and mu, (m,), and L0, (n, n); or None."""
        lx, le, ld = multipliers
        self._by_state.value = 1.0 / (lx * (1.0 - self._slack))
        self._D_u.value = self._problem.D_u * ((1.0 + self._slack) / ld)
        self._by_mu.value, self._by_rest.value = self._unit**2 / inputs, self._unit**2 * le / (1.0 - inputs)
        # With Sigma = G G' the linearized G'XG is G'L (Sigma^-1 L0 G) + its transpose - (G^-1 L0 G)'(G^-1 L0 G).
        for G, slope, offset in zip(self._error_factors, self._slopes, self._offsets, strict=True):
            inner = np.linalg.solve(G, linearize_at @ G)
            squared = inner.T @ inner
            slope.value, offset.value = le * np.linalg.solve(G.T, inner), 0.5 * le * (squared + squared.T)
        if not is_solved(self._program):
            return None
        L, F = value_of(self._L), self._unit[:, None] * value_of(self._F)
        L = 0.5 * (L + L.T)
        if np.linalg.eigvalsh(L)[0] <= 0.0:
            return None
        return CandidateDesign(L, np.linalg.solve(L, F.T).T, multipliers, inputs)


def max_slack_gain(problem: DesignProblem, design: CandidateDesign) -> np.ndarray:
    """Returns the gain, shape (m, n), with the largest slack in (I) for the design's L and multipliers.

    The slack is measured by the smallest t for which t L bounds the successors. If the solver fails, the design's own
    gain is returned.
    """
    n, m = problem.B.shape
    L, (lx, le, ld), identity, zero = design.L, design.multipliers, np.eye(n), np.zeros((n, n))
    K, t = cp.Variable((m, n)), cp.Variable()
    closed_loop = (problem.A + problem.B @ K) @ L
    limit = np.array([[1.0 - 4.0 * float(ACTION_ROUNDING)]])
    constraints = []
    for G in np.linalg.cholesky(problem.maximal_error_shapes):
        error_input = problem.B @ K @ G
        blocks = [
            [t * L - problem.D_u / ld, closed_loop, error_input],
            [closed_loop.T, lx * L, zero],
            [error_input.T, zero, le * identity],
        ]
        constraints.append(cp.bmat(blocks) >> 0)
        for i, mu in enumerate(design.inputs):
            state, error = K[i : i + 1, :] @ L, K[i : i + 1, :] @ G
            blocks = [[limit, state, error], [state.T, mu * L, zero], [error.T, zero, (1.0 - mu) * identity]]
            constraints.append(cp.bmat(blocks) >> 0)
    return value_of(K) if is_solved(cp.Problem(cp.Minimize(t), constraints)) else design.K


def best_multipliers(
    problem: DesignProblem, error_shapes: np.ndarray, L: np.ndarray, K: np.ndarray, initial: tuple[float, float, float]
) -> tuple[tuple[float, float, float], float]:
    """Returns the multipliers (lx, le, ld) of (I), and the largest eigenvalue of the successors' shape against L.

    The successors' shape is matrix-convex in the multipliers, so its largest generalized eigenvalue, over all error
    sets, (k, n, n), is a convex function of two numbers. (I) holds if it is at most 1. All is scaled.
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
