from fractions import Fraction

import numpy as np
import pytest

from shields.verification.rational_matrix import (
    add,
    congruence,
    is_positive_semidefinite,
    multiply,
    quadratic,
    rational,
    subtract,
    to_float,
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


def test_no_tolerance_at_the_boundary():
    tiny = Fraction(1, 10**40)
    one, edge = Fraction(1), [[Fraction(1), Fraction(1)], [Fraction(1), Fraction(1)]]
    assert is_positive_semidefinite(edge)
    assert not is_positive_semidefinite(edge, strict=True)
    assert not is_positive_semidefinite([[one, one], [one, one - tiny]])
    assert is_positive_semidefinite([[one, one], [one, one + tiny]], strict=True)


def test_zero_pivot_with_a_nonzero_column_is_indefinite():
    assert not is_positive_semidefinite(rational(np.array([[0.0, 1.0], [1.0, 5.0]])))
    assert is_positive_semidefinite(rational(np.array([[0.0, 0.0], [0.0, 5.0]])))


def test_asymmetric_matrices_are_refused():
    assert not is_positive_semidefinite(rational(np.array([[1.0, 1e-300], [0.0, 1.0]])))


def test_arithmetic_is_exact_where_floats_are_not():
    tenth = rational(np.array([[0.1]]))
    assert quadratic(tenth, rational(np.array([[3.0]]))) == 3 * Fraction(0.1) ** 2
    assert subtract(tenth, tenth) == [[0]]


def test_congruence_agrees_with_numpy():
    rng = np.random.default_rng(0)
    factor, matrix = rng.standard_normal((2, 3)), rng.standard_normal((3, 3))
    np.testing.assert_allclose(to_float(congruence(rational(factor), rational(matrix))), factor @ matrix @ factor.T)


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
