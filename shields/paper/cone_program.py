"""A parametrized convex program whose numbers are updated inside the solver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import clarabel
import cvxpy as cp
import numpy as np
import scipy.sparse as sp
from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import dims_to_solver_cones

# A compiled module without type stubs.
_clarabel: Any = clarabel
SOLVED, ALMOST = _clarabel.SolverStatus.Solved, _clarabel.SolverStatus.AlmostSolved


class ConeProgram:
    """max c'x subject to A(p) x + s = b(p), s in a cone, with A and b affine in a few parameters p.

    cvxpy canonicalizes once; afterwards a solve costs a small linear combination and Clarabel's own time.

    Args:
        problem: A maximization that follows cvxpy's rules for parametrized programs.
        parameters: Its scalar parameters, in the order `maximum` takes their values.
        almost: Take values of reduced accuracy too: good enough to rank by, not to decide by.
    """

    def __init__(self, problem: cp.Problem, parameters: Sequence[cp.Parameter], *, almost: bool = False) -> None:
        self._accepted = (SOLVED, ALMOST) if almost else (SOLVED,)
        base = self._data(problem, parameters, np.full(len(parameters), 1.0))
        steps = [self._data(problem, parameters, 1.0 + np.eye(len(parameters))[i]) for i in range(len(parameters))]
        self._base = base
        self._steps = [(A.data - base[0].data, b - base[1]) for A, b, _, _ in steps]
        A, b, c, cones = base
        settings = _clarabel.DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False
        settings.chordal_decomposition_enable = False
        self._solver = _clarabel.DefaultSolver(sp.csc_array((len(c), len(c))), c, A, b, cones, settings)

    @staticmethod
    def _data(problem: cp.Problem, parameters: Sequence[cp.Parameter], values: np.ndarray) -> tuple:
        """Returns (A, b, c, cones) at parameter values, with one sparsity pattern for all."""
        for parameter, value in zip(parameters, values, strict=True):
            parameter.value = float(value)
        data, _, _ = problem.get_problem_data(cp.CLARABEL)
        return sp.csc_matrix(data["A"]), data["b"], data["c"], dims_to_solver_cones(data["dims"])

    def maximum(self, values: Sequence[float]) -> float:
        """Returns the optimal value; minus infinity if there is no solution."""
        A, b = self._base[0].data.copy(), self._base[1].copy()
        for value, (dA, db) in zip(values, self._steps, strict=True):
            A += (value - 1.0) * dA
            b += (value - 1.0) * db
        self._solver.update(A=A, b=b)
        solution = self._solver.solve()
        return -float(solution.obj_val) if solution.status in self._accepted else -np.inf
