"""Matrices of rational numbers, and conditions they decide: every float is rational, so nothing rounds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm

import numpy as np

Matrix = list[list[Fraction]]


def rational(array: np.ndarray) -> Matrix:
    """Returns the exact rational value of a finite float matrix, shape (r, c)."""
    return [[Fraction(float(entry)) for entry in row] for row in np.atleast_2d(array)]


def add(*terms: Matrix) -> Matrix:
    """Returns the sum of matrices of equal shape."""
    return [[sum(entries, Fraction(0)) for entries in zip(*rows, strict=True)] for rows in zip(*terms, strict=True)]


def subtract(left: Matrix, right: Matrix) -> Matrix:
    """Returns left - right."""
    return add(left, scale(Fraction(-1), right))


def scale(factor: Fraction, matrix: Matrix) -> Matrix:
    """Returns factor * matrix."""
    return [[factor * entry for entry in row] for row in matrix]


def multiply(left: Matrix, right: Matrix) -> Matrix:
    """Returns left @ right."""
    rows, columns = [_whole(row) for row in left], [_whole(column) for column in zip(*right, strict=True)]
    return [
        [Fraction(sum(x * y for x, y in zip(row, column, strict=True)), a * b) for column, b in columns]
        for row, a in rows
    ]


def _whole(entries: Sequence[Fraction]) -> tuple[list[int], int]:
    """Returns rational numbers as whole multiples of one over a common denominator, and the denominator."""
    common = lcm(*(entry.denominator for entry in entries))
    return [entry.numerator * (common // entry.denominator) for entry in entries], common


def transpose(matrix: Matrix) -> Matrix:
    """Returns the transpose."""
    return [list(column) for column in zip(*matrix, strict=True)]


def congruence(factor: Matrix, matrix: Matrix) -> Matrix:
    """Returns factor @ matrix @ factor'."""
    return multiply(multiply(factor, matrix), transpose(factor))


def quadratic(row: Matrix, matrix: Matrix) -> Fraction:
    """Returns the number row @ matrix @ row' for a row of shape (1, n)."""
    return congruence(row, matrix)[0][0]


def weighted_size(row: Iterable[Fraction], weights: Iterable[Fraction]) -> Fraction:
    """Returns sum |q_j| w_j, the largest |q x| for |x_j| <= w_j."""
    return sum((abs(entry) * weight for entry, weight in zip(row, weights, strict=True)), Fraction(0))


def is_positive_semidefinite(matrix: Matrix, *, strict: bool = False) -> bool:
    """Returns whether a symmetric rational matrix is positive semidefinite (definite if `strict`).

    The matrix is factorized exactly into LDL'; it is semidefinite exactly if no pivot is negative and every zero pivot
    has a zero column below it. An asymmetric matrix is not semidefinite.
    """
    rest = [row[:] for row in matrix]
    size = len(rest)
    if any(rest[i][j] != rest[j][i] for i in range(size) for j in range(i)):
        return False
    for k in range(size):
        pivot = rest[k][k]
        if pivot < 0 or (strict and pivot == 0):
            return False
        below = range(k + 1, size)
        if pivot == 0:
            if any(rest[i][k] != 0 for i in below):
                return False
            continue
        for i in below:
            factor = rest[i][k] / pivot
            if factor:
                for j in range(i, size):
                    rest[i][j] -= factor * rest[k][j]
                    rest[j][i] = rest[i][j]
    return True


def to_float(matrix: Matrix) -> np.ndarray:
    """Returns the nearest float64 matrix."""
    return np.array([[float(entry) for entry in row] for row in matrix])


# Rounding an action in [-1, 1] to float32 changes it by at most this.
ACTION_ROUNDING = Fraction(1, 2**24)
# The margin of a violated condition is at most this, the largest negative float.
_LARGEST_NEGATIVE = -5e-324


@dataclass(frozen=True)
class Condition:
    """One checked condition.

    Attributes:
        name: Label of the condition in docs/shield_proof.md and what it says.
        margin: Signed margin as a float, for people: the smallest eigenvalue of a matrix inequality or the slack of a
            scalar one; at least 0 exactly if the condition holds.
        holds: Whether the condition holds, decided in exact arithmetic.
    """

    name: str
    margin: float
    holds: bool


def flag(name: str, holds: bool) -> Condition:
    """Returns a condition that is true or false and has no slack: its margin is 0 or -1."""
    return Condition(name, 0.0 if holds else -1.0, holds)


def scalar_condition(name: str, slack: Fraction) -> Condition:
    """Returns the condition slack >= 0."""
    try:
        margin = float(slack)
    except OverflowError:
        margin = np.inf if slack >= 0 else -np.inf
    # A negative slack may be too small for a float.
    return Condition(name, margin if slack >= 0 else min(margin, _LARGEST_NEGATIVE), slack >= 0)


def matrix_condition(name: str, matrix: Matrix, *, strict: bool = False) -> Condition:
    """Returns the condition that a symmetric matrix is positive semidefinite (definite if `strict`)."""
    holds = is_positive_semidefinite(matrix, strict=strict)
    try:
        smallest = float(np.linalg.eigvalsh(to_float(matrix))[0])
    except OverflowError:  # exact, but beyond any float
        smallest = np.inf if holds else -np.inf
    # Rounding may give the float the wrong sign; the exact verdict decides.
    margin = max(smallest, 0.0) if holds else min(smallest, _LARGEST_NEGATIVE)
    return Condition(name, margin, holds)
