"""Graphs of arrival histories that round error shapes more coarsely where histories hardly recur."""

import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract
from ncs_gym.estimation import arrival_histories
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.set_membership import COARSEST_STEP, SHAPE_STEP, SetMembership
from ncs_gym.estimation.vector_estimator import VectorEstimator
from ncs_gym.uncertainty.shape_matrices import is_inside
from tests.product import linear_plant, rate_limited, sampled_plant

# A motor whose speed is not measured, with sensors that are worth averaging over many samples.
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
CHANNEL = Channel(loss=0.3, max_consecutive_losses=2)


def run(coarsens, steps):
    """Follows the plant; returns its histories, the largest level of the error in its shape, and how many were new."""
    rng, state = np.random.default_rng(0), np.zeros(3)
    estimator = VectorEstimator(PLANT, histories_of(PLANT, CHANNEL, SETS, coarsens), 1)
    level, lost, unmet = 0.0, 0, 0
    for step in range(1, steps):
        state = PLANT.A @ state + PLANT.nominal_disturbance.sample_boundary(rng)
        lost = lost + 1 if rng.random() < 0.3 and lost < 2 else 0
        sample = PLANT.H @ state + PLANT.sensor_noise.bound.sample_boundary(rng)
        before = len(estimator.histories)
        estimator.advance(np.zeros((1, 1)), sample[:, None], [(0, np.array([not lost]))])
        unmet += step > steps // 2 and len(estimator.histories) != before
        error, shape = estimator.mean[:, 0] - state, estimator.histories.table.shapes[estimator.statistics[0]]
        level = max(level, float(error @ np.linalg.solve(shape, error)))
        assert is_inside(shape, SETS.shape_at(estimator.age[0]))
    assert not estimator.alarm.any()
    return estimator.histories, level, unmet


@pytest.mark.slow
def test_histories_that_hardly_recur_soon_do_and_the_error_stays_in_its_set(monkeypatch):
    monkeypatch.setattr(arrival_histories, "MAX_BYTES", 1 << 19)
    fine, _, many = run(False, 400)
    coarse, level, few = run(True, 1600)
    assert level <= 1.0
    assert fine.recursion.sets.shape_step == SHAPE_STEP
    assert coarse.recursion.sets.shape_step == COARSEST_STEP
    assert many > 0.9 * 200
    assert few < 0.5 * 800


def test_coarse_graph_stays_coarse_where_it_begins_anew_and_where_it_is_full_again(monkeypatch):
    monkeypatch.setattr(arrival_histories, "MAX_BYTES", 1 << 17)
    histories, level, _ = run(True, 800)
    assert level <= 1.0
    assert histories.coarsens
    assert histories.recursion.sets.shape_step == COARSEST_STEP
    assert histories.recursion.coarser() is histories.recursion


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


@pytest.mark.parametrize("step", [SHAPE_STEP, 2.0**-9, COARSEST_STEP])
def test_rounded_shape_holds_the_shape_and_is_not_much_larger(step):
    rng, sets = np.random.default_rng(1), SetMembership(PLANT, 0.0, SETS, shape_step=step)
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
    assert np.mean(added) < (3.1 if step == SHAPE_STEP else 1.5)
