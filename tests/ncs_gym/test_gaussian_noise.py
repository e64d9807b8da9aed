"""Noise without a bound: what is untruncated and what stays bounded, and the probability that a bound is left."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from ncs_gym import Channel, NCSVectorEnv, truck_trailer
from ncs_gym.disturbances import BallDisturbance
from ncs_gym.network.gaussian_bound import bound_violation_probability
from ncs_gym.processes.plant_step import PlantSimulation
from tests.product import library_plant, linear_plant, loop_env, vector_env

DELTA = 0.2
CALM = {"A": [[0.5]], "B": [[1.0]], "box": [[1.0]], "u_max": 1.0, "dt": 0.1, "delta": DELTA}


def energies(covariance, draws):
    """z' covariance^-1 z of draws, shape (count, n)."""
    return np.einsum("ki,ij,kj->k", draws, np.linalg.inv(covariance), draws)


def simulation_of(env):
    """What moves one environment or many."""
    size = env.num_envs if isinstance(env, NCSVectorEnv) else None
    return PlantSimulation(env.plant, env.disturbance, env.allow_assumption_violation, size, noise=env.noise)


def draws_of(env, count):
    """Process noise plus disturbance, sensor noise and first errors, by what moves one environment or many."""
    rng, process, plant = np.random.default_rng(0), simulation_of(env), env.plant
    shape = (plant.n,) if process.size is None else (plant.n, process.size)
    memory = process.begin(rng, process.size)
    zero, steps = np.zeros(shape), 0 if process.size is None else np.zeros(process.size, np.int64)
    moved = [process.draw_disturbance(rng, zero, steps, memory) for _ in range(count)]
    measured = [process.measure(rng, zero) for _ in range(count)]
    errors = [process.first_error(rng, process.size) for _ in range(count)]
    return [
        np.concatenate([np.reshape(each, (len(each), -1)).T for each in some]) for some in (moved, measured, errors)
    ]


def both(plant, **settings):
    return loop_env(plant, **settings), vector_env(20, plant=plant, **settings)


@pytest.mark.parametrize("many", [False, True])
def test_gaussian_noise_is_that_of_the_covariances_and_truncated_noise_is_not(many):
    plant = library_plant(truck_trailer, gamma=0.0, delta=DELTA)
    covariances = plant.process_noise.covariance, plant.sensor_noise.covariance, plant.initial_noise.covariance
    count = 100 if many else 2000
    for noise in ("gaussian", "truncated"):
        env = both(plant, noise=noise)[many]
        for covariance, draws in zip(covariances, draws_of(env, count), strict=True):
            assert (kstest(energies(covariance, draws), chi2(2).cdf).pvalue > 1e-3) == (noise == "gaussian")
            outside = np.mean(energies(covariance, draws) > plant.process_noise.energy)
            assert 0.7 * DELTA < outside < 1.3 * DELTA if noise == "gaussian" else outside == 0.0


def test_what_is_bounded_by_declaration_stays_inside_its_bound():
    bounds = {"disturbance_bound": 0.1, "sensor_bound": 0.2, "initial_bound": 0.3}
    for kept, covariance in (
        ("disturbance_bound", "measurement_noise_cov"),
        ("sensor_bound", "initial_cov"),
        ("initial_bound", "process_noise_cov"),
    ):
        others = {name: bound for name, bound in bounds.items() if name == kept}
        for env in both(linear_plant(**CALM, **others, **{covariance: [[1.0]]}), noise="gaussian"):
            moved, measured, errors = draws_of(env, 1000)
            sizes = {"disturbance_bound": moved, "sensor_bound": measured, "initial_bound": errors}
            assert 0.9 * bounds[kept] < np.abs(sizes[kept]).max() <= bounds[kept] * (1.0 + 1e-9)


class OwnBall(BallDisturbance):
    """A user's disturbance, which is checked at every step."""

    vectorized = True


class OwnBallAhead(OwnBall):
    """One that is drawn for many steps at once."""

    vectorized = memoryless = True


@pytest.mark.parametrize("disturbance", [OwnBall(), OwnBallAhead()])
def test_own_disturbance_inside_its_bound_is_not_blamed_for_noise_outside_it(disturbance):
    plant = linear_plant(**CALM, gamma=0.01, process_noise_cov=[[0.01]], sensor_bound=0.1, initial_bound=0.1)
    for env in both(plant, disturbance=disturbance, noise="gaussian"):
        moved = draws_of(env, 500)[0]
        assert np.mean(plant.disturbance.gauge(moved) > 1.0) > 0.01
        # Uniform plus normal: a sum that was pulled back as a whole would be smaller.
        assert np.var(moved) == pytest.approx(0.01 + 0.01 / 3.0, rel=0.25)


def test_a_disturbance_in_place_of_the_process_noise_stays_inside_its_bound():
    plant = library_plant(truck_trailer, delta=DELTA)
    for env in both(plant, disturbance="sphere", noise="gaussian"):
        moved, measured, _ = draws_of(env, 500)
        assert plant.disturbance.gauge(moved).max() <= 1.0
        assert plant.sensor_error.gauge(measured).max() > 1.0


@pytest.mark.parametrize(("delta", "steps", "period"), [(1e-9, 200, 2), (1e-3, 7, 3), (0.05, 3, 1), (1e-12, 10**9, 1)])
def test_bound_violation_probability_is_the_sum_over_all_draws_rounded_up(delta, steps, period):
    plant = library_plant(truck_trailer, delta=delta)
    wanted = (steps + steps // period + 1) * Fraction(delta)
    bound = bound_violation_probability(plant, Channel(send_period=period, loss=0.9, delay=3), steps)
    assert Fraction(bound) >= wanted
    assert bound == pytest.approx(float(wanted), rel=2e-4 if delta < 1e-11 else 1e-9)


def test_bound_violation_probability_counts_only_what_is_gaussian():
    channel = Channel(send_period=10)
    for name, draws in (("process_noise_cov", 100), ("measurement_noise_cov", 10), ("initial_cov", 1)):
        plant = linear_plant(
            **CALM | {"delta": 1e-4}, gamma=0.1, sensor_bound=0.1, initial_bound=0.1, **{name: [[1e-3]]}
        )
        assert bound_violation_probability(plant, channel, 100) == pytest.approx(draws * 1e-4, rel=1e-9)
    bounded = linear_plant(**CALM, gamma=0.01, sensor_bound=0.1, initial_bound=0.1)
    assert bound_violation_probability(bounded, channel, 10**6) == 0.0
    assert bound_violation_probability(truck_trailer(), channel, 10**6) == 1.0


def test_share_of_episodes_with_an_escape_is_what_the_bound_says():
    # Escapes counted where they happen, draw by draw: with independent draws the union bound is nearly attained.
    plant, channel = library_plant(truck_trailer, gamma=0.0, delta=1e-3), Channel(send_period=2)
    steps, count = 100, 2000
    process = simulation_of(vector_env(count, plant=plant, channel=channel, noise="gaussian"))
    rng, zero, none = np.random.default_rng(1), np.zeros((2, count)), np.zeros(count, np.int64)
    escaped = plant.initial_noise.bound.gauge(process.first_error(np.random.default_rng(0), count).T) > 1.0
    memory = process.begin(rng, count)
    for step in range(1, steps + 1):
        escaped |= plant.process_noise.bound.gauge(process.draw_disturbance(rng, zero, none, memory).T) > 1.0
        if step % channel.send_period == 0:
            escaped |= plant.sensor_noise.bound.gauge(process.measure(rng, zero).T) > 1.0
    bound = bound_violation_probability(plant, channel, steps)
    assert 0.8 * bound < escaped.mean() < bound


def test_extreme_noise_lies_on_the_bounds_in_scalar_and_vector_environments():
    plant = linear_plant(**CALM, gamma=1e-6, sensor_bound=0.1, initial_bound=0.2)
    for env in both(plant, noise="extreme"):
        _, info = env.reset(seed=3)
        np.testing.assert_allclose(np.abs(info["estimation_error"]), 0.2, rtol=1e-9)
        measured = simulation_of(env).measure(np.random.default_rng(0), 0.0 * np.atleast_1d(info["state"]).T)
        np.testing.assert_allclose(np.abs(measured), 0.1, rtol=1e-9)
