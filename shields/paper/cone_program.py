"""Small cone programs for the solver Clarabel, written with affine expressions.

An affine expression of N numbers is an array whose first axis has length N + 1: the coefficients of every number, then
the constant term. numpy's operations on the remaining axes build larger expressions from smaller ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import clarabel
import numpy as np
import scipy.sparse as sp

# A compiled module without type stubs.
_clarabel: Any = clarabel
# Relative tolerances of the solver: its own, and the least it can be asked for.
_DEFAULT_TOLERANCE, _SMALLEST_TOLERANCE = 1e-8, 1e-12


def affine_variables(*sizes: int) -> list[np.ndarray]:
    """Returns the expressions of independent vectors of numbers, one per size, and that of the constant 1."""
    coefficients = np.eye(sum(sizes) + 1)
    return np.split(coefficients, np.cumsum(sizes), axis=1)


def lower_triangular(entries: np.ndarray, n: int) -> np.ndarray:
    """Returns a lower triangular matrix expression, shape (N+1, n, n), with entries of shape (N+1, n (n+1) / 2)."""
    matrix = np.zeros((len(entries), n, n))
    matrix[:, *np.tril_indices(n)] = entries
    return matrix


def symmetric(entries: np.ndarray, n: int) -> np.ndarray:
    """Returns a symmetric matrix expression, shape (N+1, n, n), with entries of shape (N+1, n (n+1) / 2)."""
    lower = lower_triangular(entries, n)
    return lower + transposed(np.tril(lower, -1))


def transposed(expression: np.ndarray) -> np.ndarray:
    """Returns the transpose of a matrix expression."""
    return expression.swapaxes(1, 2)


def maximum(
    objective: np.ndarray,
    *,
    nonnegative: np.ndarray,
    semidefinite: Sequence[np.ndarray],
    exponential: Sequence[np.ndarray] = (),
    inaccurate: bool = False,
) -> float:
    """Returns the maximum of an expression under constraints; minus infinity if the solver finds none.

    Args:
        objective: The expression to maximize, shape (N+1,); its constant term is left out.
        nonnegative: Expressions that are at least 0, shape (N+1, k).
        semidefinite: Symmetric matrix expressions that are positive semidefinite, each of shape (N+1, r, r).
        exponential: Triples (x, y, z) with y exp(x / y) <= z and y > 0, each of shape (N+1, 3).
        inaccurate: Whether a value of reduced accuracy counts: it is good enough to rank by, not to decide by.
    """
    solution = _solution(objective, nonnegative, semidefinite, exponential, _DEFAULT_TOLERANCE)
    accepted = [_clarabel.SolverStatus.Solved] + [_clarabel.SolverStatus.AlmostSolved] * inaccurate
    return -float(solution.obj_val) if solution.status in accepted else -np.inf


def maximizer(
    objective: np.ndarray,
    *,
    nonnegative: np.ndarray,
    semidefinite: Sequence[np.ndarray],
    exponential: Sequence[np.ndarray] = (),
) -> np.ndarray | None:
    """Returns the numbers, shape (N,), at which `maximum` is attained, accurately; None if the solver finds none.

    Near a maximum the objective is flat: its value with half as many digits is what the default tolerance gives, so
    the solver goes on for as long as it can.
    """
    solution = _solution(objective, nonnegative, semidefinite, exponential, _SMALLEST_TOLERANCE)
    accepted = (_clarabel.SolverStatus.Solved, _clarabel.SolverStatus.AlmostSolved)
    return np.array(solution.x) if solution.status in accepted else None


def _solution(
    objective: np.ndarray,
    nonnegative: np.ndarray,
    semidefinite: Sequence[np.ndarray],
    exponential: Sequence[np.ndarray],
    tolerance: float,
) -> Any:
    """Returns what the solver found, up to a relative tolerance."""
    rows = np.concatenate([nonnegative, *map(_triangle, semidefinite), *exponential], axis=1)
    cones = [_clarabel.NonnegativeConeT(nonnegative.shape[1])]
    cones += [_clarabel.PSDTriangleConeT(matrix.shape[1]) for matrix in semidefinite]
    cones += [_clarabel.ExponentialConeT() for _ in exponential]
    settings = _clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    # Clarabel minimizes q'x subject to A x + s = b with s in the cones, so s = b - A x are the rows.
    size = len(objective) - 1
    A, b, q = sp.csc_array(-rows[:-1].T), rows[-1], -objective[:-1]
    return _clarabel.DefaultSolver(sp.csc_array((size, size)), q, A, b, cones, settings).solve()


def _triangle(matrix: np.ndarray) -> np.ndarray:
    """Returns the upper triangle of a symmetric expression column by column, off-diagonal entries times sqrt(2)."""
    i, j, weights = _triangle_indices(matrix.shape[1])
    return matrix[:, i, j] * weights


@cache
def _triangle_indices(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns rows and columns of the upper triangle column by column, and 1 or sqrt(2) for each entry."""
    j, i = np.tril_indices(n)
    return i, j, np.where(i == j, 1.0, np.sqrt(2.0))
