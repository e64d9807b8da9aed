from fractions import Fraction

import numpy as np
import pytest

from shields.verification.rational_matrix import (
    add,
    is_positive_semidefinite,
    multiply,
    rational,
    subtract,
    transpose,
)


def minors_say_semidefinite(matrix: np.ndarray) -> bool:
    """By the other criterion: all principal minors are nonnegative (integers, exact by cofactor expansion)."""

    def determinant(rows: list[list[int]]) -> int:
        if not rows:
            return 1
        return sum(
            (-1) ** j * rows[0][j] * determinant([row[:j] + row[j + 1 :] for row in rows[1:]]) for j in range(len(rows))
        )

    n = len(matrix)
    picks = ([i for i in range(n) if mask >> i & 1] for mask in range(1, 2**n))
    return all(determinant([[int(matrix[i, j]) for j in pick] for i in pick]) >= 0 for pick in picks)


def test_asymmetric_matrices_are_refused():
    assert not is_positive_semidefinite(rational(np.array([[1.0, 1e-300], [0.0, 1.0]])))


def test_non_finite_floats_cannot_enter():
    with pytest.raises((ValueError, OverflowError)):
        rational(np.array([[np.nan]]))


def test_what_does_not_fit_together_is_an_error_not_a_shorter_sum():
    square, row, ragged = rational(np.eye(2)), rational(np.ones((1, 3))), [[Fraction(1), Fraction(2)], [Fraction(3)]]
    for wrong in (lambda: multiply(square, row), lambda: multiply(square, ragged), lambda: transpose(ragged)):
        with pytest.raises(ValueError, match="zip"):
            wrong()
    for wrong in (lambda: add(square, rational(np.ones((1, 2)))), lambda: subtract(square, ragged)):
        with pytest.raises(ValueError, match="zip"):
            wrong()
