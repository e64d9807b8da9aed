"""Rational matrices of FLINT and what is decided of them: every float is a rational number, nothing is rounded."""

from __future__ import annotations

from typing import Any

import numpy as np
from flint import fmpq, fmpq_mat

from shields.verification.rational_matrix import Condition

# An action in [-1, 1] that becomes a float32 moves by at most half a unit in the last of 24 binary digits.
FLOAT32 = fmpq(1, 2**24)
# Bits of ball arithmetic: far more than what conditions keep from their limits.
PRECISION = 256
# Margins are for people, their sign is not: that of a condition that does not hold is below zero.
_JUST_NEGATIVE = -float(np.nextafter(0.0, 1.0))


def number(value: Any) -> Any:
    """Returns the rational number that a finite float is."""
    return fmpq(*float(value).as_integer_ratio())


def matrix(array: np.ndarray) -> Any:
    """Returns the rational matrix that a finite float matrix is; a vector becomes a row."""
    return fmpq_mat([[number(entry) for entry in row] for row in np.atleast_2d(array).tolist()])


def identity(size: int) -> Any:
    """Returns the identity, shape (size, size)."""
    return fmpq_mat(size, size, [int(i == j) for i in range(size) for j in range(size)])


def mapped(factor: Any, shape: Any) -> Any:
    """Returns factor @ shape @ factor', the shape of an ellipsoid's image."""
    return factor * shape * factor.transpose()


def form(row: Any, shape: Any) -> Any:
    """Returns the number row @ shape @ row'."""
    return mapped(row, shape)[0, 0]


def reach_of(row: Any, sizes: list[Any]) -> Any:
    """Returns the largest |row @ x| for |x_j| <= sizes_j, of a matrix with one row."""
    return sum((abs(row[0, j]) * size for j, size in enumerate(sizes)), fmpq(0))


def is_semidefinite(symmetric: Any, *, strictly: bool = False) -> bool:
    """Returns whether a rational matrix is symmetric and has no negative eigenvalue (only positive ones if `strictly`).

    A symmetric matrix has real eigenvalues, and det(x I - M) = x^n - e_1 x^(n-1) + e_2 x^(n-2) - .. with e_k their
    elementary symmetric sums. If no eigenvalue is negative, no e_k is. If no e_k is, then at -x, x > 0, the polynomial
    is (-1)^n (x^n + e_1 x^(n-1) + ..), which is not zero. Positive eigenvalues have e_k > 0, and e_n is their product.
    """
    if symmetric != symmetric.transpose():
        return False
    whole, _ = symmetric.numer_denom()  # the common denominator is positive
    sums = [-entry if power % 2 else entry for power, entry in enumerate(reversed(whole.charpoly().coeffs()))]
    return all(entry > 0 for entry in sums) if strictly else all(entry >= 0 for entry in sums)


def definite(name: str, difference: Any, unit: Any = 1, *, strictly: bool = False) -> Condition:
    """Returns the condition that a matrix, times a positive unit, is semidefinite (definite if `strictly`)."""
    holds = is_semidefinite(difference, strictly=strictly)
    try:
        entries = [[float(entry / unit) for entry in row] for row in difference.tolist()]
        margin = float(np.linalg.eigvalsh(np.array(entries))[0])
    except OverflowError:
        margin = np.inf
    return Condition(name, _signed(margin, holds), holds)


def at_least_zero(name: str, difference: Any, unit: Any = 1) -> Condition:
    """Returns the condition that a rational number, multiplied with a positive unit, is not negative."""
    holds = bool(difference >= 0)
    try:
        margin = float(difference / unit)
    except OverflowError:
        margin = np.inf
    return Condition(name, _signed(margin, holds), holds)


def ball_at_least_zero(name: str, ball: Any) -> Condition:
    """Returns the condition that every number in a ball is not negative; a ball around zero does not hold."""
    holds = bool(ball >= 0)
    return Condition(name, _signed(float(ball.mid()), holds), holds)


def is_so(name: str, holds: bool) -> Condition:
    """Returns a condition without a margin: 0 if it holds, else -1."""
    return Condition(name, 0.0 if holds else -1.0, holds)


def _signed(margin: float, holds: bool) -> float:
    """Returns a margin, which rounding may have moved across zero, with the sign of the verdict."""
    if holds:
        return max(margin, 0.0)
    return -np.inf if margin == np.inf else min(margin, _JUST_NEGATIVE)
