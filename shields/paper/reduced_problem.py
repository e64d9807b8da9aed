"""OP with its auxiliary variables U and tau eliminated: a small cone program per point (kappa, rho)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym import LinearPlant
from shields.paper.bounds import PaperBounds
from shields.paper.cone_program import affine_variables, lower_triangular, maximizer, maximum, symmetric, transposed
from shields.paper.optimization_problem import NormalizedPlant

# In units of the safe box, a lambda_min(L) below this is the solver's inaccuracy.
_SMALLEST_EIGENVALUE = 1e-7
# A quotient alpha^2 / eps_up above this no longer limits the inputs.
_LARGEST_QUOTIENT = 1e9


class ReducedProblem:
    """OP of one plant with U and tau eliminated exactly.

    The best U is (alpha^2 / eps_up) I, with which (C5) and (C6) become one matrix inequality per input.

    Args:
        plant: The plant; of its bounds only the safe box and the input limits are used.
    """

    def __init__(self, plant: LinearPlant) -> None:
        self._unit = NormalizedPlant.of(plant)
        self._m, self._n = plant.m, plant.n

    def largest_eigenvalue(self, bounds: PaperBounds, *, with_error: bool = True) -> float:
        """Returns the largest lambda_min(L) under all constraints but (C2): OP is feasible exactly if it reaches alpha.

        The best beta of (C7) is lambda_min(L) itself, so beta is what is maximized.

        Args:
            bounds: kappa, rho and the constants of OP at them.
            with_error: False drops the communication error from the input limit, which leaves
                K_i L K_i' <= u_max^2 / 2 and makes the value independent of gamma, Q and P0.

        Returns:
            The eigenvalue [square of the states' unit]; minus infinity if none exceeds the solver's inaccuracy.
        """
        n, m = self._n, self._m
        entries, F, beta, one = affine_variables(n * (n + 1) // 2, m * n, 1)
        L, F = symmetric(entries, n), F.reshape(-1, m, n)
        quotient = self._quotient(bounds) if with_error else None
        value = maximum(
            beta[:, 0],
            nonnegative=self._box_slacks(L, one),
            semidefinite=self._matrices(L, F, beta, one, bounds, quotient),
        )
        return self._unit.size**2 * value if value > _SMALLEST_EIGENVALUE else -np.inf

    def largest_log_det(self, bounds: PaperBounds) -> float:
        """Returns the largest log det L under all constraints; minus infinity if the solver finds none."""
        program = self._log_det_program(bounds, with_margin=True, with_error=True)
        return maximum(**program, inaccurate=True) + 2.0 * self._n * float(np.log(self._unit.size))

    def largest_set(
        self, bounds: PaperBounds, *, with_margin: bool = True, with_error: bool = True
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns L, shape (n, n), and K, shape (m, n), of the largest log det L; None if the solver finds none.

        Args:
            bounds: kappa, rho and the constants of OP at them.
            with_margin: False drops (C2).
            with_error: False drops the communication error from the input limit, as in `largest_eigenvalue`.
        """
        n, m, unit = self._n, self._m, self._unit
        numbers = maximizer(**self._log_det_program(bounds, with_margin=with_margin, with_error=with_error))
        if numbers is None:
            return None
        triangle = n * (n + 1) // 2
        L = symmetric(numbers[None, :triangle], n)[0]
        F = numbers[triangle : triangle + m * n].reshape(m, n)
        return unit.size**2 * L, unit.u_max[:, None] * np.linalg.solve(L, F.T).T / unit.size

    def _log_det_program(self, bounds: PaperBounds, *, with_margin: bool, with_error: bool) -> dict[str, Any]:
        """Returns the arguments of `maximum`; the first numbers are the entries of L, then those of F.

        log det L is the largest sum of log Z_ii with [diag(Z_ii), Z'; Z, L] >= 0 and Z lower triangular.
        """
        n, m = self._n, self._m
        triangle = n * (n + 1) // 2
        entries, F, beta, factor, logarithms, one = affine_variables(triangle, m * n, 1, triangle, n)
        L, F, Z = symmetric(entries, n), F.reshape(-1, m, n), lower_triangular(factor, n)
        alpha = bounds.alpha / self._unit.size**2
        return {
            "objective": logarithms.sum(axis=1),
            "nonnegative": self._box_slacks(L, one),
            "semidefinite": [
                *([L - alpha * _multiple(one, n)] if with_margin else []),  # (C2)
                *self._matrices(L, F, beta, one, bounds, self._quotient(bounds) if with_error else None),
                np.block([[Z * np.eye(n), transposed(Z)], [Z, L]]),
            ],
            "exponential": [np.column_stack([logarithms[:, i], one, Z[:, i, i]]) for i in range(n)],
        }

    def _box_slacks(self, L: np.ndarray, one: np.ndarray) -> np.ndarray:
        """Returns 1 - c_j L c_j' of (C3), shape (N+1, k)."""
        return one - np.einsum("ij,njk,ik->ni", self._unit.C, L, self._unit.C)

    def _matrices(
        self,
        L: np.ndarray,
        F: np.ndarray,
        beta: np.ndarray,
        one: np.ndarray,
        bounds: PaperBounds,
        quotient: float | None,
    ) -> list[np.ndarray]:
        """Returns the matrices of (C1), (C7) and (C4)-(C6) for a quotient alpha^2 / eps_up, None for no error."""
        n = self._n
        closed_loop = self._unit.A @ L + self._unit.B @ F
        matrices = [
            np.block([[bounds.kappa * L, transposed(closed_loop)], [closed_loop, L]]),
            L - _multiple(beta, n),
            bounds.rho * _multiple(beta, n) - L,
        ]
        limit = 0.5 * one[:, :, None]
        for i in range(self._m):
            row = F[:, i : i + 1]
            if quotient is None:
                blocks = [[limit, row], [transposed(row), L]]
            else:
                zero, U = np.zeros_like(L), quotient * _multiple(one, n)
                blocks = [[limit, row, row], [transposed(row), L, zero], [transposed(row), zero, U]]
            matrices.append(np.block(blocks))
        return matrices

    def _quotient(self, bounds: PaperBounds) -> float:
        """Returns alpha^2 / eps_up in units of the safe box, reduced to where it no longer matters."""
        if bounds.epsilon_up == 0.0:
            return _LARGEST_QUOTIENT
        return min(bounds.alpha / self._unit.size**2 * bounds.alpha / bounds.epsilon_up, _LARGEST_QUOTIENT)


def _multiple(scalar: np.ndarray, n: int) -> np.ndarray:
    """Returns the expression of a scalar, shape (N+1, 1), times the identity."""
    return scalar[:, :, None] * np.eye(n)
