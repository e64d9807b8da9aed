import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy.linalg import expm

from ncs_gym import truck_trailer
from ncs_gym.ellipsoid import TruncatedGaussian, truncation_energy
from ncs_gym.plants.library import convoy, lane_keeping, stirred_tank
from tests.product import altered, library_plant

BOUNDS = ("disturbance_bound", "sensor_bound", "initial_bound")


def test_truck_trailer_reproduces_the_printed_matrices():
    plant = truck_trailer()
    np.testing.assert_allclose(plant.A, [[0.7247, 0.1636], [-0.7361, -0.0278]], atol=5e-5)
    np.testing.assert_allclose(plant.B, [[0.0612], [0.1636]], atol=5e-5)


def test_sensor_bound_with_quantizer_holds_corners_of_the_rounding_box():
    plant = truck_trailer()
    step = 0.05
    noise, bound = plant.sensor_error.shape_matrix, plant.sensor_error_with(step)
    corner = np.array([step / 2, -step / 2])
    extreme = corner + np.sqrt(noise[0, 0]) * corner / np.linalg.norm(corner) * (1 - 1e-9)
    assert bound.contains(extreme)
    assert not bound.contains(1.01 * extreme)


@pytest.mark.parametrize("degrees", [2, 4, 6])
@pytest.mark.parametrize("delta", [0.999, 0.05, 1e-12])
def test_truncation_energy_is_the_smallest_float_that_cuts_off_no_more_than_delta(delta, degrees):
    """An even number of degrees has the tail e^-h (1 + h + h^2/2 + ..), h half of the energy."""
    tails = []
    for energy in (truncation_energy(delta, degrees), math.nextafter(truncation_energy(delta, degrees), 0.0)):
        with localcontext(prec=60):
            half = Decimal(energy) / 2
            tails.append((-half).exp() * sum(half**k / math.factorial(k) for k in range(degrees // 2)))
    assert tails[0] <= Decimal(delta) < tails[1]


def test_truncated_noise_stays_in_its_bound_and_keeps_its_mass():
    rng = np.random.default_rng(4)
    covariance = np.array([[2.0, 0.3], [0.3, 0.5]])
    noise = TruncatedGaussian(covariance, truncation_energy(0.5, 2))
    samples = np.array([noise.sample(rng) for _ in range(4000)])
    assert all(noise.bound.gauge(sample) <= 1.0 + 1e-12 for sample in samples)
    # A Gaussian truncated at its median energy keeps 1 - log 2 of its covariance in two dimensions.
    np.testing.assert_allclose(np.cov(samples.T), (1.0 - np.log(2.0)) * covariance, atol=0.05)


def test_fingerprint_changes_with_every_number():
    base = truck_trailer()
    others = [
        truck_trailer(mass=1000.0001),
        library_plant(truck_trailer, gamma=5.0000001e-4),
        library_plant(truck_trailer, delta=0.051),
        library_plant(truck_trailer, u_max=4.0000001),
        library_plant(truck_trailer, initial_cov=2e-4 * np.eye(2)),
        library_plant(truck_trailer, H=np.array([[1.0, 0.0]])),
        altered(base, A=0.9 * base.A, continuous_model=None),
        altered(base, operating_state=[1.0, 0.0]),
        altered(base, operating_input=[1.0]),
        *(altered(base, between_samples=points) for points in (8, 9)),
        *(altered(base, **{name: 0.04}) for name in BOUNDS),
        (ends := altered(base, box_ends=-base.box_ends[::-1] * [1.0, 0.9])),
    ]
    for name in ("box_ends", "input_ends"):
        for i in range(2):
            (moved := getattr(ends, name).copy())[i] *= 1.0 + 1e-12
            others.append(altered(ends, **{name: moved}))
    prints = {plant.fingerprint for plant in (base, *others)}
    assert len(prints) == 1 + len(others)
    zero = {"operating_state": [0.0, 0.0], "between_samples": 1} | dict.fromkeys(BOUNDS, 0.0)
    for same in (truck_trailer(), altered(base), altered(base, A=base.A), altered(base, **zero)):
        assert same.fingerprint == base.fingerprint


def test_tank_runs_away_at_the_rate_of_its_unstable_pole():
    growth = max(abs(np.linalg.eigvals(stirred_tank().A)))
    assert np.log(growth) * 60.0 / 3.0 == pytest.approx(2.83, abs=0.01)  # per minute, of a step of 3 s


def test_follower_falls_back_by_what_the_leader_gains():
    plant, v = convoy(), np.array([0.0, 1.0])
    away = expm(np.array([[0.0, -1.0], [0.0, -1.0 / 0.3]]) * 0.1) @ v
    np.testing.assert_allclose(plant.A @ v, away, rtol=1e-12)
    assert np.sqrt(plant.of_disturbance.bound.shape_matrix[0, 0]) == pytest.approx(0.45 * 0.1)


def test_car_moves_sideways_with_its_heading():
    plant = lane_keeping()
    np.testing.assert_allclose(plant.A, [[1.0, 20.0 * 0.05], [0.0, 1.0]], rtol=1e-12)
    np.testing.assert_allclose(plant.B, [[20.0 * 0.05**2 / 2.0], [0.05]], rtol=1e-12)
