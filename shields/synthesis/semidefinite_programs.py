"""Solving semidefinite programs, and the largest ellipsoid in a box."""

from __future__ import annotations

import warnings

import cvxpy as cp
import numpy as np

from shields.errors import Infeasible


def is_solved(program: cp.Problem) -> bool:
    """Solves a program and returns whether all its variables have finite values; exact verification judges them."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "solution may be inaccurate": verified exactly afterwards
            program.solve(solver=cp.CLARABEL)
    except (cp.SolverError, ArithmeticError, ValueError):
        return False
    if program.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        return False
    return all(variable.value is not None and np.isfinite(variable.value).all() for variable in program.variables())


def value_of(variable: cp.Variable) -> np.ndarray:
    """Returns the value of a variable of a solved program.

    Raises:
        ValueError: If the solver found none.
    """
    if variable.value is None:
        raise ValueError(f"the solver found no value of {variable}")
    return variable.value


def largest_box_ellipsoid(C: np.ndarray) -> np.ndarray:
    """Returns the shape (n, n) of the largest ellipsoid in the box {|c_j x| <= 1}.

    Args:
        C: Rows c_j of the box, shape (k, n), of full column rank.

    Raises:
        Infeasible: If the solver fails.
    """
    k, n = C.shape
    if k == n:
        inverse = np.linalg.inv(C)
        return inverse @ inverse.T
    scale = np.linalg.cholesky(np.linalg.inv(C.T @ C))
    L = cp.Variable((n, n), symmetric=True)
    program = cp.Problem(cp.Maximize(cp.log_det(L)), [cp.diag((C @ scale) @ L @ (C @ scale).T) <= 1])
    if not is_solved(program):
        raise Infeasible("the solver did not find the largest ellipsoid in the safe box", "S", float("nan"))
    return scale @ value_of(L) @ scale.T
