"""The linear matrix inequalities of the certified method for fixed multipliers (theory.md section 3)."""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from shields.synthesis.design_problem import CandidateDesign, DesignProblem
from shields.synthesis.semidefinite_programs import is_solved, value_of
from shields.verification import ACTION_ROUNDING


class InvariantSetProgram:
    """Maximizes log det L over (L, K) for fixed multipliers, with X <= L Sigma^-1 L linearized at a given L0.

    With F = K L the conditions (I), (U), (S) of theory.md section 3 are linear matrix inequalities. The program is
    canonicalized once; multipliers and linearization are its parameters.

    Args:
        problem: The scaled design problem.
        slack: Relative tightening of the conditions, which exact verification needs: the disturbance and error sets
            are enlarged and the limits reduced by this fraction.
    """

    def __init__(self, problem: DesignProblem, slack: float) -> None:
        n, m = problem.n, problem.m
        self._problem, self._slack = problem, slack
        self._error_factors = list(np.linalg.cholesky((1.0 + slack) * problem.maximal_error_shapes))
        self._L, self._F = cp.Variable((n, n), symmetric=True), cp.Variable((m, n))
        self._lx, self._mu = cp.Parameter(nonneg=True), cp.Parameter(m, nonneg=True)
        self._D_u = cp.Parameter((n, n), symmetric=True)
        # Slopes and offsets of the blocks le X and (1 - mu_i) X, in coordinates in which Sigma is the identity (a small
        # Sigma would spoil the solver's accuracy). Each block has parameters of its own, because cvxpy allows no
        # products of parameters.
        self._slopes = [[cp.Parameter((n, n)) for _ in range(m + 1)] for _ in self._error_factors]
        self._offsets = [[cp.Parameter((n, n), symmetric=True) for _ in range(m + 1)] for _ in self._error_factors]
        self._program = cp.Problem(cp.Maximize(cp.log_det(self._L)), self._constraints())

    def _constraints(self) -> list[cp.Constraint]:
        """Returns (S), and (I) and (U) for every maximal error set, as linear matrix inequalities."""
        problem, L = self._problem, self._L
        constraints: list[cp.Constraint] = [cp.diag(problem.C @ L @ problem.C.T) <= 1.0 - self._slack]
        for G, slopes, offsets in zip(self._error_factors, self._slopes, self._offsets, strict=True):
            X = [G.T @ L @ slope + slope.T @ L @ G - offset for slope, offset in zip(slopes, offsets, strict=True)]
            constraints += self._constraints_of_one_set(G, X)
        return constraints

    def _constraints_of_one_set(self, G: np.ndarray, X: list[cp.Expression]) -> list[cp.Constraint]:
        """Returns (I) and (U) for the error set E(G G'), given the blocks le X and (1 - mu_i) X in its coordinates."""
        problem, L, F = self._problem, self._L, self._F
        zero = np.zeros((problem.n, problem.n))
        closed_loop, error_input = problem.A @ L + problem.B @ F, problem.B @ F @ G
        blocks = [
            [L - self._D_u, closed_loop, error_input],
            [closed_loop.T, self._lx * L, zero],
            [error_input.T, zero, X[0]],
        ]
        constraints: list[cp.Constraint] = [cp.bmat(blocks) >> 0]
        limit = np.array([[1.0 - self._slack - 2.0 * float(ACTION_ROUNDING)]])
        for i in range(problem.m):
            row = F[i : i + 1, :]
            blocks = [[limit, row, row @ G], [row.T, self._mu[i] * L, zero], [(row @ G).T, zero, X[i + 1]]]
            constraints.append(cp.bmat(blocks) >> 0)
        return constraints

    def solve(
        self,
        multipliers: tuple[float, float, float],
        inputs: np.ndarray,
        linearize_at: np.ndarray,
    ) -> CandidateDesign | None:
        """Returns the design of largest volume for given multipliers; None if there is none.

        Args:
            multipliers: Multipliers (lx, le, ld) > 0 that sum to 1.
            inputs: Multipliers mu_i in (0, 1), shape (m,).
            linearize_at: The shape L0 at which X is linearized, (n, n).
        """
        lx, le, ld = multipliers
        self._lx.value = lx * (1.0 - self._slack)
        self._D_u.value = self._problem.D_u * ((1.0 + self._slack) / ld)
        self._mu.value = inputs
        # With Sigma = G G' the linearized G'XG is G'L (Sigma^-1 L0 G) + its transpose - (G^-1 L0 G)'(G^-1 L0 G).
        for G, slopes, offsets in zip(self._error_factors, self._slopes, self._offsets, strict=True):
            inner = np.linalg.solve(G, linearize_at @ G)
            slope, offset = np.linalg.solve(G.T, inner), inner.T @ inner
            for factor, P, R in zip((le, *(1.0 - inputs)), slopes, offsets, strict=True):
                P.value, R.value = factor * slope, 0.5 * factor * (offset + offset.T)
        if not is_solved(self._program):
            return None
        L, F = value_of(self._L), value_of(self._F)
        L = 0.5 * (L + L.T)
        sign, log_det = np.linalg.slogdet(L)
        if sign <= 0 or np.linalg.eigvalsh(L)[0] <= 0.0:
            return None
        return CandidateDesign(L, np.linalg.solve(L, F.T).T, multipliers, inputs, float(log_det))


def max_slack_gain(problem: DesignProblem, design: CandidateDesign) -> np.ndarray:
    """Returns the gain, shape (m, n), with the largest slack in (I) for the design's L and multipliers.

    The slack is measured by the smallest t for which t L bounds the successors. If the solver fails, the design's own
    gain is returned.
    """
    n, m = problem.n, problem.m
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
