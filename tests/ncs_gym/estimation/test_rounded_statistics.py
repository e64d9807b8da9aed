"""Covariances and shapes are rounded so that histories recur, and shapes still hold what they held."""

import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.set_membership import SHAPE_STEP, SetMembership
from ncs_gym.estimation.vector_estimator import VectorEstimator
from ncs_gym.uncertainty.shape_matrices import is_inside
from tests.product import linear_plant, rate_limited, sampled_plant

# A motor whose speed is not measured.
PLANT = linear_plant(
    A=[[1.0, 0.0099, 0.0010], [0.0, 0.98, 0.19], [0.0, -0.0047, 0.90]],
    B=[[0.0], [0.01], [0.095]],
    H=[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    box=[1.0, 5.0, 3.0],
    u_max=5.0,
    dt=0.01,
    disturbance_bound=[5e-4, 5e-3, 5e-3],
    sensor_bound=[2e-3, 0.01],
    initial_bound=[2e-3, 0.01, 0.01],
)
SETS = certified_error_set(PLANT, ChannelContract(2))


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
    for _ in range(200):
        samples, arrives = np.zeros((plant.p, 64)), rng.random(64) < 0.7
        estimator.advance(np.zeros((plant.m, 64)), samples, [(1, arrived)])
        arrived = arrives
        counts.append(len(histories))
    assert counts[-1] < 2_500
    assert counts[-1] - counts[100] < 0.15 * counts[-1]
    for number in np.unique(estimator.statistics):
        covariance = histories.table.statistics(number).covariance
        assert not covariance[exactly].any()
        assert np.linalg.eigvalsh(np.delete(np.delete(covariance, exactly, 0), exactly, 1))[0] > 0.0


def test_rounded_shape_holds_the_shape_and_is_not_much_larger():
    rng, sets, step = np.random.default_rng(1), SetMembership(PLANT, 0.0, SETS), SHAPE_STEP
    ball = np.linalg.cholesky(SETS.shape_at(0))
    added = []
    for _ in range(200):
        factor = rng.normal(size=(3, 3)) * 0.4
        shape = ball @ factor @ factor.T @ ball.T
        rounded = sets.rounded_up(shape)
        assert is_inside(shape, rounded)
        inner = np.linalg.solve(ball, np.linalg.solve(ball, rounded).T)
        room = np.linalg.eigvalsh(inner - factor @ factor.T)[0]
        assert room >= (3.0 - 1e-6) * 2.0**-14  # what the rounding of updated estimates is covered with
        assert np.allclose(inner / step, np.rint(inner / step), atol=1e-6)
        added.append(np.trace(inner - factor @ factor.T) / (3.0 * step))
    assert np.mean(added) < 3.1
