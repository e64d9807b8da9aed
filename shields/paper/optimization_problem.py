"""The published optimization problem OP (Liu et al. Definition 4), as printed.

It is written once, in cvxpy. Its parameters are kappa, rho and the constants that follow from them, so that one
compiled program serves all points (kappa, rho) and all bounds on the uncertainty.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from ncs_gym import LinearPlant
from shields.paper.bounds import SYMMETRIC, PaperBounds
from shields.synthesis.semidefinite_programs import largest_box_ellipsoid, value_of

# In units of the safe box, a lambda_min(L) below this is the solver's inaccuracy.
_SMALLEST_EIGENVALUE = 1e-7
# The least tolerances that the solver can be asked for. Near a maximum the objective is flat: L and K are known to half
# as many digits as their log det L.
_ACCURATE = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-12)


@dataclass(frozen=True, eq=False)
class OPSolution:
    """A solution of OP.

    Attributes:
        L: Shape of the safe set, (n, n).
        K: Gain, shape (m, n) [input per state].
        bounds: kappa, rho and the constants of OP at them.
    """

    L: np.ndarray
    K: np.ndarray
    bounds: PaperBounds


class OptimizationProblem:
    """OP of one plant, for any bounds on its uncertainty.

    It is solved in units in which the safe box is of size 1 and every input is limited by 1. All states share one unit,
    so that OP's identity matrices stay: with x = size x', L = size^2 L', and alpha and eps_up are divided by size^2.
    The auxiliary matrix U is printed in units of alpha^2 / eps_up.

    Args:
        plant: The plant with symmetric limits and a bounded safe box; its uncertainty is not used.

    Raises:
        Infeasible: If the solver fails to find the size of the safe box.
        ValueError: If the limits are not symmetric.
    """

    def __init__(self, plant: LinearPlant) -> None:
        if not plant.is_symmetric:
            raise ValueError(f"the paper's method knows {SYMMETRIC}: use shields.synthesize")
        self._n, self._u_max = plant.n, plant.largest_input
        self._size = float(np.linalg.det(largest_box_ellipsoid(plant.box))) ** (0.5 / plant.n)
        self._A, self._B, self._C = plant.A, plant.B * plant.largest_input / self._size, plant.box * self._size
        self._kappa, self._rho, self._alpha = (cp.Parameter(nonneg=True) for _ in range(3))
        # sqrt(eps_up) / alpha, 0 without communication error; and how much of the box and of u_max^2 may be used.
        self._error, self._share = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._F, self._beta = cp.Variable((plant.m, plant.n)), cp.Variable()
        self._general = self._programs(cp.Variable((plant.n, plant.n), symmetric=True))
        self._of_balls = self._programs(self._beta * np.eye(plant.n))

    def _programs(self, L: cp.Expression) -> tuple[cp.Expression, cp.Problem, cp.Problem]:
        """Returns L, the program of the largest lambda_min(L), which has all constraints but (C2), and OP."""
        n, F, beta, identity = self._n, self._F, self._beta, np.eye(self._n)
        U, closed_loop = cp.Variable((n, n), symmetric=True), self._A @ L + self._B @ F
        constraints = [
            cp.bmat([[self._kappa * L, closed_loop.T], [closed_loop, L]]) >> 0,  # (C1)
            cp.diag(self._C @ L @ self._C.T) <= self._share,  # (C3)
            U << identity,  # (C4)
        ]
        for i in range(len(self._u_max)):
            row, tau = F[i : i + 1, :], cp.Variable((1, 1))
            constraints += [
                cp.bmat([[0.5 * self._share - tau, row], [row.T, L]]) >> 0,  # (C5), u_max = 1
                cp.bmat([[tau, self._error * row], [self._error * row.T, U]]) >> 0,  # (C6)
            ]
        if isinstance(L, cp.Variable):
            constraints += [L >> beta * identity, L << self._rho * beta * identity]  # (C7)
        margin = L >> self._alpha * identity  # (C2)
        largest = cp.Problem(cp.Maximize(beta), constraints)
        return L, largest, cp.Problem(cp.Maximize(cp.log_det(L)), [*constraints, margin])

    def largest_eigenvalue(self, bounds: PaperBounds, *, with_error: bool = True) -> float:
        """Returns the largest lambda_min(L) under all constraints but (C2): OP is feasible exactly if it reaches alpha.

        Minus infinity if none exceeds the solver's inaccuracy. The best beta of (C7) is lambda_min(L), so beta is
        maximized.

        Args:
            bounds: kappa, rho and the constants of OP at them.
            with_error: False drops the communication error from the input limit, which leaves
                K_i L K_i' <= u_max^2 / 2 and makes the value independent of gamma, Q and P0.
        """
        self._set(bounds, slack=0.0, with_error=with_error)
        _, largest, _ = self._at(bounds.rho)
        eigenvalue = float(value_of(self._beta)) if _solved(largest, {cp.OPTIMAL}) else -np.inf
        return self._size**2 * eigenvalue if eigenvalue > _SMALLEST_EIGENVALUE else -np.inf

    def solution(self, bounds: PaperBounds, *, slack: float = 0.0, with_error: bool = True) -> OPSolution | None:
        """Returns the solution of OP at one (kappa, rho); None if the solver finds none.

        Args:
            bounds: kappa, rho and the constants of OP at them.
            slack: Relative tightening of the constraints.
            with_error: False drops (C2), and the communication error from the input limit as in `largest_eigenvalue`.
        """
        self._set(bounds, slack=slack, with_error=with_error)
        L, _, problem = self._at(bounds.rho)
        if not _solved(problem, {cp.OPTIMAL, cp.OPTIMAL_INACCURATE}, **_ACCURATE) or L.value is None:
            return None
        shape = 0.5 * (L.value + L.value.T)
        if not np.isfinite(shape).all() or np.linalg.eigvalsh(shape)[0] <= 0.0:
            return None
        K = self._u_max[:, None] * np.linalg.solve(shape, value_of(self._F).T).T / self._size
        return OPSolution(self._size**2 * shape, K, bounds)

    def _at(self, rho: float) -> tuple[cp.Expression, cp.Problem, cp.Problem]:
        """Returns the programs for a rho; (C7) with rho = 1 says L = beta I, which leaves no interior to a matrix L."""
        return self._of_balls if rho == 1.0 else self._general

    def _set(self, bounds: PaperBounds, *, slack: float, with_error: bool) -> None:
        less, more = 1.0 - slack, 1.0 + slack
        has_error = with_error and bounds.epsilon_up > 0.0
        self._kappa.value, self._share.value = less * bounds.kappa, less
        self._rho.value = less / more * bounds.rho
        self._alpha.value = more * bounds.alpha / self._size**2 if with_error else 0.0
        self._error.value = (bounds.epsilon_up / less) ** 0.5 * self._size / bounds.alpha if has_error else 0.0


def _solved(program: cp.Problem, accepted: set[str], **tolerances: float) -> bool:
    """Solves a program and returns whether its status is accepted; it does not begin from an earlier solution."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "solution may be inaccurate": the status says so, too
            program.solve(solver=cp.CLARABEL, warm_start=False, **tolerances)
    except (cp.SolverError, ArithmeticError, ValueError):
        return False
    return program.status in accepted
