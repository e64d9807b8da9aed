"""Bounds of a plant: what is declared in plain terms adds to gamma and to the truncated covariances."""

import numpy as np
import pytest

import ncs_gym
from ncs_gym import Ellipsoid, truck_trailer
from ncs_gym.disturbances import BY_NAME, as_disturbance
from ncs_gym.estimation.estimator import Estimator
from shields.verification.rational_matrix import congruence, is_positive_semidefinite, rational, subtract
from tests.plants import SOURCES
from tests.product import altered, linear_plant

BOUNDS = {"disturbance_bound": 0.01, "sensor_bound": 0.02, "initial_bound": 0.03}
SETS = {"disturbance_bound": "disturbance", "sensor_bound": "sensor_error", "initial_bound": "initial_error"}
KINDS = {
    "half-widths": [0.05, 0.002],
    "ellipsoid": Ellipsoid([[4e-3, 1e-3], [1e-3, 2e-3]]),
    "directions": ([[0.1], [0.5]], 0.2),
}


def plain(**changes):
    settings = {"A": 0.5 * np.eye(2), "B": np.ones((2, 1)), "box": [1.0, 2.0], "u_max": 1.0, "dt": 0.1} | BOUNDS
    return linear_plant(**(settings | changes))


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("kind", KINDS)
def test_declared_bound_alone_is_the_set_but_for_rounding(name, kind):
    declared = plain(**{name: KINDS[kind]})
    shape = getattr(declared, SETS[name]).shape_matrix
    np.testing.assert_allclose(shape, getattr(declared, SOURCES[name]).bound.shape_matrix, rtol=1e-8, atol=1e-12)
    assert np.linalg.eigvalsh(shape - getattr(declared, SOURCES[name]).bound.shape_matrix)[0] > -1e-20


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("kind", KINDS)
def test_declared_bound_adds_to_what_covariances_and_gamma_bound(name, kind):
    base = truck_trailer()
    plant = altered(base, **{name: KINDS[kind]})
    for direction in np.random.default_rng(0).standard_normal((200, 2)):
        need = getattr(base, SETS[name]).support(direction) + getattr(plant, SOURCES[name]).bound.support(direction)
        assert getattr(plant, SETS[name]).support(direction) >= need * (1 - 1e-8)


@pytest.mark.cases(8)
@pytest.mark.parametrize("name", BY_NAME)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gamma", [0.0, 1e-3])
def test_every_disturbance_uses_the_declared_bound_and_stays_inside(name, kind, gamma):
    plant = plain(gamma=gamma, disturbance_bound=KINDS[kind])
    source, rng = as_disturbance(name, plant, False), np.random.default_rng(0)
    memory = source.begin(rng, plant, 50)
    d = np.stack([source.draw(rng, plant, rng.standard_normal((2, 50)), k, memory) for k in range(40)])
    d = d.swapaxes(1, 2).reshape(-1, 2)
    assert plant.allowed_disturbance.gauge(d).max() <= 1.0
    first = as_disturbance(name, plant, False).draw(rng, plant, np.ones(2), 3, source.begin(rng, plant))
    assert first.shape == (2,)
    axis = plant.of_disturbance.bound.factor @ np.linalg.svd(plant.of_disturbance.bound.factor)[2][0]
    beyond_gamma = np.abs(d @ axis).max() / np.linalg.norm(axis) - np.sqrt(gamma)
    assert beyond_gamma > 0.4 * np.linalg.norm(axis)


def test_estimator_picks_useful_gains_from_declared_bounds_alone():
    """Without a covariance the filter would not believe its sensors at all."""
    plant = plain(A=0.95 * np.eye(2), disturbance_bound=0.1, sensor_bound=0.01)
    estimator = Estimator(plant, ncs_gym.Channel())
    estimator.reset(np.zeros(2))
    for step in range(1, 6):
        estimator.advance(np.zeros(1), [ncs_gym.Packet(step, np.array([0.3, -0.2]))])
    np.testing.assert_allclose(estimator.mean, [0.3, -0.2], atol=0.02)


def test_first_error_along_an_oblique_line_is_held_in_rational_arithmetic():
    for ratio in np.random.default_rng(0).uniform(-2.0, 2.0, 40):
        bound = plain(initial_bound=([[1.0], [ratio]], 1.0)).initial_error
        line = rational(np.array([[1.0], [ratio]]))
        assert is_positive_semidefinite(
            subtract(rational(bound.shape_matrix), congruence(line, rational(np.ones((1, 1)))))
        )


@pytest.mark.parametrize(
    "given",
    [
        np.array([[0.1, 0.3], [0.3, 0.9]], np.float32),  # a perfect correlation, rounded
        [[1.0, 0.5], [0.5 * (1.0 + 1e-9), 1.0]],
    ],
)
def test_covariance_may_lack_the_rounding_of_its_own_type(given):
    kept = plain(process_noise_cov=given).process_noise.covariance
    assert np.array_equal(kept, kept.T)
    np.testing.assert_allclose(kept, given, rtol=2e-6)
    assert is_positive_semidefinite(rational(kept))
    asked = np.asarray(given, np.float64)
    assert (np.diag(kept) >= np.diag(asked)).all()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([[1e-12, 2e-9], [2.1e-9, 1.0]], "symmetric"),
        ([[1e-12, 1e-6, 0.0], [1e-6, 1.0, 0.1], [0.0, 0.1, 1.0]], "positive semidefinite"),
        ([[0.0, 1e-9], [1e-9, 1.0]], "positive semidefinite"),
    ],
)
def test_more_than_rounding_of_a_covariance_is_seen_in_whatever_units(given, message):
    with pytest.raises(ValueError, match=message):
        plain(A=0.5 * np.eye(len(given)), B=np.ones((len(given), 1)), box=1.0, process_noise_cov=given)
