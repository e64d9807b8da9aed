"""Covariances and shapes are rounded so that histories recur, and shapes still hold what they held."""

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, cart_pole
from ncs_gym.ellipsoid import is_inside
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.estimator import VectorEstimator
from ncs_gym.estimation.kalman_filter import SHAPE_STEP, SetMembership
from tests.product import linear_plant, rate_limited, sampled_plant


def spring(**changes):
    """A mass on a spring, position and speed measured; both are disturbed."""
    given = {"state_limits": ([-2.0, -2.0], [2.0, 2.0]), "input_limits": ([-1.0], [1.0]), "disturbance_bound": 0.01}
    model = [[0.0, 1.0], [-1.0, -0.7]], [[0.0], [1.0]], np.eye(2), 0
    return sampled_plant(model, 0.1, sensor_bound=0.01, initial_bound=0.01, **(given | changes))


# What is known exactly: inputs under way, past inputs; what soon is known nearly so: the speed of who drives ahead.
KNOWN = {
    "input delay": (spring(input_delay=2), None, [2, 3]),
    "rate limit": (rate_limited(spring(), 0.2), None, [2]),
    "undisturbed state": (
        linear_plant(
            A=[[1.0, -0.085], [0.0, 0.7165]],
            B=[[0.1], [0.0]],
            box=np.eye(2),
            u_max=1.0,
            dt=0.1,
            disturbance_bound=[0.01, 0.0],
            sensor_bound=0.01,
            initial_bound=0.01,
        ),
        ChannelContract(8),
        [],
    ),
}


@pytest.mark.parametrize("case", KNOWN)
def test_histories_recur_where_states_are_known_exactly_or_become_so(case):
    """They did not: each prediction gave such a plant a covariance of its own, and every step a new history."""
    plant, contract, exactly = KNOWN[case]
    histories = histories_of(plant, Channel(delay=1), certified_error_set(plant, contract))
    estimator, rng, arrived = VectorEstimator(plant, histories, 64), np.random.default_rng(0), np.zeros(64, np.bool_)
    counts = []
    for _ in range(120):
        samples, arrives = np.zeros((plant.p, 64)), rng.random(64) < 0.7
        estimator.advance(np.zeros((plant.m, 64)), samples, [(1, arrived)])
        arrived = arrives
        counts.append(len(histories))
    assert counts[-1] < 2_500
    assert counts[-1] - counts[60] < 0.15 * counts[-1]
    for number in np.unique(estimator.statistics):
        covariance = histories.table.statistics(number).covariance
        assert not covariance[exactly].any()
        assert np.linalg.eigvalsh(np.delete(np.delete(covariance, exactly, 0), exactly, 1))[0] > 0.0


def test_rounded_shape_holds_the_shape_and_is_not_much_larger():
    plant = cart_pole(full_state=False)
    certified, n = certified_error_set(plant, ChannelContract(2)), plant.n
    rng, sets, step = np.random.default_rng(1), SetMembership(plant, 0.0, certified), SHAPE_STEP
    ball = np.linalg.cholesky(certified.shape_at(0))
    added = []
    for _ in range(200):
        factor = rng.normal(size=(n, n)) * 0.4
        shape = ball @ factor @ factor.T @ ball.T
        rounded = sets.rounded_up(shape)
        assert is_inside(shape, rounded)
        inner = np.linalg.solve(ball, np.linalg.solve(ball, rounded).T)
        room = np.linalg.eigvalsh(inner - factor @ factor.T)[0]
        assert room >= (n - 1e-6) * 2.0**-14  # what the rounding of updated estimates is covered with
        assert np.allclose(inner / step, np.rint(inner / step), atol=1e-6)
        added.append(np.trace(inner - factor @ factor.T) / (n * step))
    assert np.mean(added) < n + 0.1


# Gymnasium's pendulum, sampled every second step on a channel without a contract: 14,000 histories, and slow because of
# them (docs/vector.md). InvertedPendulum-v0 needs MuJoCo.
EXCEPTED = {"ncs_gym/Pendulum-v0", "ncs_gym/InvertedPendulum-v0", "ncs_gym/LinearNCS-v0"}
IDS = sorted(each for each in gym.registry if each.startswith("ncs_gym/") and each not in EXCEPTED)
# Convoy-v0 has 4,000 and ConvoyOnRequest-v0 5,000; shapes that do not recur make more than 11,000.
MOST = 6_000


@pytest.mark.cases(1)
@pytest.mark.parametrize("env_id", IDS)
def test_histories_of_a_vector_recur(env_id):
    envs = gym.make_vec(env_id, 1024)
    envs.reset(seed=0)
    idle = np.zeros(envs.action_space.shape, np.float32)
    for _ in range(30):
        envs.step(idle)
    assert len(envs.unwrapped._now.estimator.histories) < MOST
