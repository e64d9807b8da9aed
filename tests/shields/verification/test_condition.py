from fractions import Fraction

import numpy as np
import pytest

from shields.verification.condition import flag, matrix_condition, scalar_condition

BEYOND_FLOATS = Fraction(10) ** 400


@pytest.mark.parametrize("slack", [0, 1, Fraction(1, 3), 1 / BEYOND_FLOATS, BEYOND_FLOATS])
def test_scalar_conditions_hold_from_zero_on_and_not_below(slack):
    slack = Fraction(slack)
    assert scalar_condition("(S)", slack).holds
    assert scalar_condition("(S)", slack).margin >= 0.0
    assert scalar_condition("(S)", -slack).holds == (slack == 0)
    assert scalar_condition("(S)", -slack).margin <= 0.0


def test_slacks_beyond_any_float_keep_their_sign():
    assert [scalar_condition("(S)", slack).margin for slack in (BEYOND_FLOATS, -BEYOND_FLOATS)] == [np.inf, -np.inf]
    for factor, margin in ((1, np.inf), (-1, -np.inf)):
        condition = matrix_condition("(M)", [[factor * BEYOND_FLOATS]])
        assert condition.margin == margin
        assert condition.holds == (factor > 0)


def test_singular_matrices_pass_unless_the_condition_is_strict():
    singular = [[Fraction(1), Fraction(1)], [Fraction(1), Fraction(1)]]
    assert matrix_condition("(M)", singular).holds
    assert matrix_condition("(M)", singular).margin >= 0.0
    strict = matrix_condition("(M)", singular, strict=True)
    assert not strict.holds
    assert strict.margin < 0.0


@pytest.mark.parametrize("size", [Fraction(1), Fraction(10) ** 20, 1 / Fraction(10) ** 20])
def test_margins_have_the_sign_of_the_exact_verdict(size):
    # Singular but for a fraction of 1e-40, which no float shows.
    for tiny in (Fraction(1, 10**40), -Fraction(1, 10**40)):
        matrix = [[size * Fraction(1, 9), size * Fraction(1, 3)], [size * Fraction(1, 3), size * (1 + tiny)]]
        condition = matrix_condition("(M)", matrix)
        assert condition.holds == (tiny > 0)
        assert (condition.margin >= 0.0) == (tiny > 0)


def test_flags_that_are_down_have_a_negative_margin():
    assert flag("(F)", True).margin == 0.0
    assert flag("(F)", False).margin < 0.0
