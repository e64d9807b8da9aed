"""Sparse matrices of scipy are matrices: in state-space models, and wherever a plant takes numbers."""

import numpy as np
import pytest
from scipy import signal, sparse

from ncs_gym import Ellipsoid, Regulation
from ncs_gym.validation import MOST_EXPANDED, as_numbers
from tests.product import linear_plant, sampled_plant

A, B, C, D = np.array([[0.0, 1.0], [-2.0, -1.0]]), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1))
REST = {"box": 1.0, "u_max": 1.0, "disturbance_bound": 0.01, "sensor_bound": 0.01, "initial_bound": 0.01}
KINDS = [sparse.csr_matrix, sparse.csc_array, sparse.coo_matrix, sparse.dia_array, sparse.lil_matrix, sparse.dok_array]


class Model:
    """A model with sparse matrices, as those of large systems are."""

    def __init__(self, kind):
        self.A, self.B, self.C, self.D, self.dt = kind(A), kind(B), kind(C), kind(D), 0


@pytest.mark.parametrize("kind", KINDS)
def test_sparse_state_space_model_is_the_dense_one(kind):
    dense = sampled_plant((A, B, C, D), 0.1, **REST)
    for model in ((kind(A), kind(B), kind(C), kind(D)), Model(kind), (kind(A), B, C, kind(D))):
        assert sampled_plant(model, 0.1, **REST).fingerprint == dense.fingerprint
    discrete = signal.cont2discrete((A, B, C, D), 0.1)[:4]
    made = sampled_plant((*map(kind, discrete), 0.1), **REST)
    assert made.fingerprint == sampled_plant((*discrete, 0.1), **REST).fingerprint


@pytest.mark.parametrize("kind", KINDS)
def test_every_matrix_of_a_plant_may_be_sparse(kind):
    rows, covariance = np.array([[1.0, 0.0], [0.5, 1.0]]), np.diag([1e-4, 2e-4])
    given = {"A": 0.5 * np.eye(2), "B": B, "H": C, "box": rows, "process_noise_cov": covariance}
    rest = {"u_max": 1.0, "dt": 1.0, "measurement_noise_cov": covariance, "initial_bound": 0.0}
    made = linear_plant(**{name: kind(value) for name, value in given.items()}, **rest)
    assert made.fingerprint == linear_plant(**given, **rest).fingerprint
    np.testing.assert_array_equal(Ellipsoid(kind(covariance)).shape_matrix, covariance)
    np.testing.assert_array_equal(Regulation(state_cost=kind(covariance)).state_cost, covariance)


def test_sparse_matrix_that_is_too_large_is_not_expanded():
    size = int(MOST_EXPANDED**0.5) + 1
    too_large = {"A": sparse.identity(size, format="csr"), "B": np.ones((size, 1)), "box": np.ones(size)}
    with pytest.raises(ValueError, match=f"A is a sparse matrix of {size} x {size} entries, which is not expanded"):
        linear_plant(**too_large, u_max=1.0, dt=0.1)
    with pytest.raises(ValueError, match=r"A is a sparse matrix of .* reduce the model"):
        sampled_plant((sparse.eye(size), sparse.eye(size), sparse.eye(size), 0.0), 0.1, **REST)
    assert as_numbers(sparse.coo_array((10**9, 10**9))) is None
