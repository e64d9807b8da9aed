"""After an outage of any length a kept contract brings the error back into its certified set, in a few periods."""

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, Packet
from ncs_gym.ellipsoid import is_inside
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.kalman_filter import ErrorRecursion
from tests.plants import random_plant
from tests.product import altered

IDS = ("CartPole", "CartPoleNonlinear", "BatchReactor", "CSTR", "Convoy", "LaneKeeping", "Pendulum")


def registered(name):
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    return env.plant, env.certificate_contract


def unstable(seed):
    """A random plant whose eigenvalues reach beyond the circle."""
    plant = random_plant(seed, *[(2, 1), (3, 2, 1), (4, 2, 2), (4, 1, 3)][seed % 4])
    return altered(plant, A=plant.A * (1.0 + 0.04 * (seed % 3)) / plant.spectral_radius), ChannelContract(1 + seed % 3)


def steps_back(plant, contract, outage, period):
    """How many steps after an outage of so many the error's ellipsoid lies in the certified set again.

    Samples come every `period` steps before and after; infinite if it does not within 100.
    """
    error_set = certified_error_set(plant, contract)
    recursion, steps = ErrorRecursion(plant, contract.quantization_step, error_set), 0

    def heard_after(known, count):
        for _ in range(count):
            known = recursion.predicted(known)
        return recursion.updated(known)[1]

    known = recursion.first
    for _ in range(5):
        known = heard_after(known, period)
        assert is_inside(known.shape, error_set.shape_at(0))
    known = heard_after(known, outage)
    while not is_inside(known.shape, error_set.shape_at(0)):
        if steps >= 100:
            return np.inf
        known, steps = heard_after(known, period), steps + period
    return steps


@pytest.mark.cases(4)
@pytest.mark.parametrize("contracts", [2, 10, 100])
@pytest.mark.parametrize("name", IDS)
def test_registered_plants_come_back(name, contracts):
    plant, contract = registered(name)
    for period in (1, contract.max_age + 1):  # as often and as rarely as the contract allows
        assert steps_back(plant, contract, contracts * contract.max_age, period) <= 70


@pytest.mark.cases(3)
@pytest.mark.parametrize("seed", range(6))
def test_random_unstable_plants_come_back(seed):
    plant, contract = unstable(seed)
    for contracts in (2, 100):
        assert steps_back(plant, contract, contracts * contract.max_age, contract.max_age + 1) <= 70


@pytest.mark.parametrize("arrivals", [{7: [4, 7], 8: [1, 8]}, {7: [4, 7], 9: [1, 9]}])
def test_a_sample_from_before_an_outage_takes_no_error_out_of_its_set(arrivals):
    """The error was certified at its step, too, but not all the time since."""
    plant, contract = registered("BatchReactor")[0], ChannelContract(1)
    error_set, channel = certified_error_set(plant, contract), Channel(jitter=10)
    estimator, certified = Estimator(plant, channel, error_set), []
    estimator.reset(np.zeros(plant.n))
    for step in range(1, 10):
        samples = [Packet(stamp, np.zeros(plant.p), estimator.episode) for stamp in arrivals.get(step, [])]
        estimator.advance(np.zeros(plant.m), samples)
        certified.append(estimator.table.is_certified(estimator.numbered([])[1]))
    last = max(arrivals)
    assert certified[:7] == [True, True, False, False, False, False, True]
    assert certified[6:last] == [True] * (last - 6)


def test_the_ellipsoid_of_the_way_back_holds_the_error():
    # With errors, disturbances and noise on the boundary, farthest in the direction that the next prediction turns to.
    plant, contract = registered("BatchReactor")
    recursion = ErrorRecursion(plant, contract.quantization_step, certified_error_set(plant, contract))
    rng, known = np.random.default_rng(0), recursion.first
    errors = np.linalg.cholesky(known.shape) @ directions(rng, plant.n)
    outside, largest = 0, 0.0
    for step in range(90):
        known = recursion.predicted(known)
        errors = plant.A @ errors - np.linalg.cholesky(plant.disturbance.shape_matrix) @ directions(rng, plant.n)
        if step < 30 or step % 3:  # an outage, and then the oldest samples that the contract allows
            continue
        gain, known = recursion.updated(known)
        noise = np.linalg.cholesky(recursion.sets.noise) @ directions(rng, plant.p)
        errors = errors - gain @ (plant.H @ errors + noise)
        gauges = np.sqrt((errors * np.linalg.solve(known.shape, errors)).sum(axis=0))
        outside += not is_inside(known.shape, recursion.error_set.shape_at(0))
        largest = max(largest, gauges.max())
        assert gauges.max() <= 1.0
    assert outside > 2
    assert largest > 0.3


def directions(rng, size, count=2000):
    """Random unit vectors, shape (size, count)."""
    vectors = rng.standard_normal((size, count))
    return vectors / np.linalg.norm(vectors, axis=0)
