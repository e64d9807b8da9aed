from fractions import Fraction

import numpy as np
import pytest

from ncs_gym import Ellipsoid, ErrorSetError, UnstablePlantError, truck_trailer
from ncs_gym.estimation.error_bound import ErrorSet, certified_error_set, require_error_set
from shields.verification.rational_matrix import add, congruence, is_positive_semidefinite, rational, scale, subtract
from tests.plants import random_plant
from tests.product import library_plant, linear_plant


@pytest.mark.parametrize("seed", range(3))
def test_error_never_leaves_the_set_without_any_packet(seed):
    plant = random_plant(seed, 1 + seed % 5, 1)
    errors = Ellipsoid(certified_error_set(plant).Sigma)
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(plant.n)
    weight = np.outer(axis, axis)  # push the error along one axis as far as it goes
    e = plant.initial_error.extreme_point(axis)
    largest = 0.0
    for _ in range(200):
        e = plant.A @ e
        e = e + plant.disturbance.farthest_point(e, weight)
        largest = max(largest, errors.gauge(e))
    assert largest <= 1.0


KNOWN = {"gamma": 0.0, **dict.fromkeys(("measurement_noise_cov", "initial_cov"), np.zeros((2, 2)))}
PERFECT = library_plant(truck_trailer, process_noise_cov=np.zeros((2, 2)), **KNOWN)
FLAT = library_plant(truck_trailer, process_noise_cov=np.diag([0.0, 1e-4]), **KNOWN)


@pytest.mark.parametrize("plant", [library_plant(truck_trailer, initial_cov=0.2 * np.eye(2)), FLAT, PERFECT])
def test_set_covers_a_bad_first_estimate_and_leaves_slack_in_every_direction(plant):
    errors = certified_error_set(plant)
    assert plant is not PERFECT or np.linalg.eigvalsh(errors.Sigma)[1] < 1e-9
    slack = np.linalg.eigvalsh(errors.Sigma - plant.initial_error.shape_matrix)[0]
    grown = plant.A @ errors.Sigma @ plant.A.T / errors.rates[-1] + plant.disturbance.shape_matrix / (
        1.0 - errors.rates[-1]
    )
    assert slack > 0.0
    assert np.linalg.eigvalsh(errors.Sigma - grown)[0] > 0.0


@pytest.mark.cases(4)
@pytest.mark.parametrize("n", [4, 12])
@pytest.mark.parametrize("radius", [0.5, 0.99, 0.9999])
@pytest.mark.parametrize("seed", range(3))
def test_strongly_coupled_plants_get_a_true_set_or_an_error(seed, radius, n):
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    A = basis @ np.triu(3.0 * rng.standard_normal((n, n)), 1) @ basis.T + radius * np.eye(n)
    plant = linear_plant(A=A, B=np.ones((n, 1)), box=np.eye(n), u_max=1.0, dt=0.1, gamma=1e-6)
    try:
        errors = certified_error_set(plant)
    except (ErrorSetError, UnstablePlantError):
        return
    rate, Sigma = Fraction(errors.rates[-1]), rational(errors.Sigma)
    moved = congruence(rational(plant.A), Sigma)
    grown = add(scale(1 / rate, moved), scale(1 / (1 - rate), rational(plant.disturbance.shape_matrix)))
    assert is_positive_semidefinite(subtract(Sigma, grown))


@pytest.mark.parametrize("growth", [1.0, 1.0 + 2.0**-50, 1.0 + 1e-10])
def test_set_that_holds_by_no_more_than_rounding_is_an_error(growth):
    # As below; without a first error (E1) alone decides.
    settings = {"disturbance_bound": 0.1, "sensor_bound": 0.1, "initial_bound": 0.0}
    plant = linear_plant(A=[[0.5]], B=[[1.0]], box=[1.0], u_max=1.0, dt=0.1, **settings)
    Sigma = growth * 4.0 * plant.disturbance.shape_matrix
    errors = ErrorSet(shapes=np.array([Sigma]), rates=np.array([0.5]))
    if growth > 1.0 + 1e-12:
        require_error_set(errors, plant)
    else:
        with pytest.raises(ErrorSetError, match=r"\(E1\)"):
            require_error_set(errors, plant)


def test_set_that_fails_a_condition_in_one_direction_is_an_error():
    # With A = I/2, D = I and a rate of 1/2, (E1) says Sigma >= 2 D/(1/2) = 4.
    bounds = {"disturbance_bound": 1.0, "sensor_bound": 0.0}

    def check(Sigma, first):
        initial = Ellipsoid(np.diag(first))
        plant = linear_plant(
            A=0.5 * np.eye(2), B=np.eye(2), box=1.0, u_max=1.0, dt=0.1, initial_bound=initial, **bounds
        )
        require_error_set(ErrorSet(shapes=np.array([Sigma]), rates=np.array([0.5])), plant)

    check(4.01 * np.eye(2), [2.0, 1.0])
    with pytest.raises(ErrorSetError, match=r"\(E1\)"):
        check(np.diag([4.01, 3.99]), [2.0, 1.0])
    with pytest.raises(ErrorSetError, match=r"\(E0\)"):
        check(4.01 * np.eye(2), [5.0, 1.0])
    with pytest.raises(ErrorSetError), np.errstate(invalid="ignore"):
        check(np.full((2, 2), np.inf), [2.0, 1.0])
