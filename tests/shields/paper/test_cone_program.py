import numpy as np
import pytest

from shields.paper.cone_program import affine_variables, lower_triangular, maximizer, maximum, symmetric, transposed


def test_variables_and_the_constant_are_independent():
    x, y, one = affine_variables(2, 1)
    np.testing.assert_array_equal(np.concatenate([x, y, one], axis=1), np.eye(4))


def test_matrix_expressions_have_the_entries_given():
    entries, _ = affine_variables(3)
    numbers = np.array([1.0, 2.0, 3.0, 1.0])
    np.testing.assert_array_equal(np.tensordot(numbers, lower_triangular(entries, 2), 1), [[1.0, 0.0], [2.0, 3.0]])
    np.testing.assert_array_equal(np.tensordot(numbers, symmetric(entries, 2), 1), [[1.0, 2.0], [2.0, 3.0]])
    np.testing.assert_array_equal(
        np.tensordot(numbers, transposed(lower_triangular(entries, 2)), 1), [[1.0, 2.0], [0.0, 3.0]]
    )


@pytest.mark.parametrize("seed", range(3))
def test_smallest_eigenvalue_is_the_largest_shift_that_stays_semidefinite(seed):
    matrix = np.random.default_rng(seed).standard_normal((3, 3))
    matrix = matrix + matrix.T
    t, one = affine_variables(1)
    shifted = one[:, :, None] * matrix - t[:, :, None] * np.eye(3)
    value = maximum(t[:, 0], nonnegative=100.0 * one - t, semidefinite=[shifted])
    assert value == pytest.approx(np.linalg.eigvalsh(matrix)[0], abs=1e-6)


def test_exponential_cone_gives_the_logarithm():
    t, one = affine_variables(1)
    value = maximum(t[:, 0], nonnegative=one, semidefinite=[], exponential=[np.column_stack([t, one, 5.0 * one])])
    assert value == pytest.approx(np.log(5.0), abs=1e-6)


def test_constraints_that_contradict_or_do_not_bound_have_no_maximum():
    t, one = affine_variables(1)
    contradiction = np.column_stack([t - one, -t])
    assert maximum(t[:, 0], nonnegative=contradiction, semidefinite=[]) == -np.inf
    assert maximum(t[:, 0], nonnegative=t, semidefinite=[], inaccurate=True) == -np.inf


def test_maximizer_is_where_the_maximum_is_attained():
    # The largest t with [1, t; t, s] >= 0 and s <= 4 is 2, at s = 4.
    t, s, one = affine_variables(1, 1)
    matrix = np.block([[one[:, :, None], t[:, :, None]], [t[:, :, None], s[:, :, None]]])
    found = maximizer(t[:, 0], nonnegative=4.0 * one - s, semidefinite=[matrix])
    np.testing.assert_allclose(found, [2.0, 4.0], atol=1e-9)
    assert maximizer(t[:, 0], nonnegative=np.column_stack([t - one, -t]), semidefinite=[]) is None
