"""Numbers that are rounded once: compared with Python's fractions, with scipy, and with closed forms."""

import math
from fractions import Fraction

import numpy as np
import pytest
from flint import arb
from scipy.linalg import expm

from ncs_gym import exact
from ncs_gym.model import zero_order_hold

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_product_and_inverse_are_those_of_fractions_rounded_once(n):
    A, B, v = RNG.standard_normal((n, n)), RNG.standard_normal((n, n)), RNG.standard_normal(n)
    rows = [[Fraction(x) for x in row] for row in A.tolist()]
    columns = [[Fraction(x) for x in column] for column in B.T.tolist()]
    expected = [[float(sum(a * b for a, b in zip(row, column, strict=True))) for column in columns] for row in rows]
    np.testing.assert_array_equal(exact.product(A, B), expected)
    vector = [float(sum(a * Fraction(b) for a, b in zip(row, v.tolist(), strict=True))) for row in rows]
    np.testing.assert_array_equal(exact.product(A, v), vector)
    np.testing.assert_allclose(exact.product(A, exact.inverse(A)), np.eye(n), atol=1e-10)


@pytest.mark.parametrize("n", [1, 3, 6])
def test_exponential_is_scipys_to_its_rounding(n):
    A = RNG.standard_normal((n, n))
    np.testing.assert_allclose(exact.exponential(A, 0.3), expm(0.3 * A), rtol=1e-12, atol=1e-13)


def test_exponential_of_known_entries_is_the_nearest_float():
    """The series of e^t in fractions, and entries that are zero or a float because others cancel."""
    series = sum(Fraction(0.1) ** k / math.factorial(k) for k in range(30))
    assert exact.exponential(np.array([[1.0]]), 0.1)[0, 0] == float(series)
    spring = np.array([[-1.0, 1.0, 0.0], [1.0, -2.0, 1.0], [0.0, 1.0, -1.0]])
    block = np.zeros((7, 7))
    block[:3, 3:6], block[3:6, :3], block[3:6, 6] = np.eye(3), 3.3 * spring, [1.0, 0.0, -1.0]
    pushed = exact.exponential(block, 0.1)[:6, 6]
    assert pushed[1] == pushed[4] == 0.0
    assert pushed[0] == -pushed[2] > 0.0
    integrator = exact.exponential(np.array([[0.0, 1.0 + 2.0**-52], [0.0, 0.0]]), 1.5)
    np.testing.assert_array_equal(integrator, [[1.0, 1.5 * (1.0 + 2.0**-52)], [0.0, 1.0]])


def test_tie_between_two_floats_goes_to_the_even_one_and_what_is_unknown_is_an_error():
    around_zero = arb(0, 1) * arb(0.5) ** 6000
    assert exact.nearest(lambda: [arb(1.0) + arb(2.0**-53) + around_zero]) == [1.0]
    assert exact.nearest(lambda: [arb(1.0) + arb(3.0 * 2.0**-53) + around_zero]) == [1.0 + 2.0**-51]
    with pytest.raises(OverflowError):
        exact.nearest(lambda: [arb(0.0, 1.0)])
    with pytest.raises(OverflowError):
        exact.nearest(lambda: [arb("inf")])


def test_model_that_comes_to_rest_within_a_step_is_sampled():
    for size in (1e3, 1e13, 1e20):
        A, B = zero_order_hold(np.array([[-size]]), np.array([[1.0]]), 1.0)
        assert (A.item(), B.item()) == (0.0, 1.0 / size)  # as rational numbers these would fill the memory


def test_rounding_keeps_digits_of_the_largest_number():
    np.testing.assert_array_equal(exact.rounded(np.array([123.456, 0.0123, -1e-9]), 4), [123.5, 0.0, 0.0])
    np.testing.assert_array_equal(
        exact.rounded([[123.456, 0.1], [0.0123456, 0.0]], 4, axis=1), [[123.5, 0.1], [0.01235, 0]]
    )
    assert float(exact.rounded(14.7345, 3)) == 14.7
    assert float(exact.rounded(0.0, 3)) == 0.0
    assert exact.total(np.array([1e16, 1.0, -1e16])) == 1.0
