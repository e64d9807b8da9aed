"""Solving semidefinite programs, the largest ellipsoid in a box, and the extreme points of rows and a cone."""

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
    """Returns the value of a variable of a solved program; raises ValueError if the solver found none."""
    if variable.value is None:
        raise ValueError(f"the solver found no value of {variable}")
    return variable.value


def largest_box_ellipsoid(C: np.ndarray) -> np.ndarray:
    """Returns the shape (n, n) of the largest ellipsoid in the box |C x| <= 1, C of shape (k, n) and full column rank.

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


def extreme_points(
    row: np.ndarray, rows: np.ndarray, low: np.ndarray, high: np.ndarray, cone: np.ndarray, radius: float
) -> np.ndarray | None:
    """Returns the points z with the least and the largest row z, shape (2, q); None where a solver finds none.

    They are those with low <= rows z <= high, rows of shape (r, q), and |cone z| <= radius, for a cone of shape (k, q).
    """
    z, ends = cp.Variable(len(row)), []
    constraints: list[cp.Constraint] = [rows @ z >= low, rows @ z <= high]
    if len(cone):
        constraints += [cp.norm(cone @ z) <= radius]
    size = float(np.abs(row).max()) or 1.0
    for sign in (-1.0, 1.0):
        if not is_solved(cp.Problem(cp.Maximize(sign / size * row @ z), constraints)):
            return None
        ends.append(value_of(z))
    return np.array(ends)
