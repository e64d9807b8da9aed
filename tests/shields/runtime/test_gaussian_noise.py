"""The shield under noise that may leave every bound: what it still does, and how often the safe set is left."""

from functools import cache

import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, cart_pole, truck_trailer
from ncs_gym.network.gaussian_bound import bound_violation_probability
from ncs_gym.plants.library import batch_reactor
from shields.runtime.guarantee import ALARM
from shields.runtime.safety_filter import MODES
from tests.certificates import certificate_of, metric
from tests.product import library_plant, linear_plant, vector_env, vector_shield
from tests.shields.attacks.adversary import gauges

# So large a delta that draws leave their ellipsoids all the time.
WILD = 0.97
LOOPS = {
    "truck": (library_plant(truck_trailer, mass=4000.0, delta=WILD), None, Channel(loss=0.3, send_period=2, delay=2)),
    "cart-pole": (
        library_plant(cart_pole, delta=WILD),
        ChannelContract(4),
        Channel(loss=0.6, max_consecutive_losses=2, jitter=2),
    ),
    "batch reactor": (
        library_plant(batch_reactor, delta=WILD),
        ChannelContract(3),
        Channel(loss=1.0, max_consecutive_losses=2, delay=1),
    ),
}


@pytest.mark.cases(1)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "name", [each if each == "truck" else pytest.param(each, marks=pytest.mark.slow) for each in LOOPS]
)
def test_shield_goes_on_when_draws_leave_their_ellipsoids(name, mode):
    plant, contract, channel = LOOPS[name]
    settings = {"channel": channel, "contract": contract, "noise": "gaussian", "max_episode_steps": 60}
    shield = vector_shield(vector_env(20, plant=plant, **settings), certificate_of(plant, contract), mode=mode)
    shield.reset(seed=0)
    escaped, alarms, reasons, rng = False, 0, set(), np.random.default_rng(0)
    for _ in range(80):
        *_, info = shield.step(rng.uniform(-1.0, 1.0, shield.action_space.shape).astype(np.float32))
        escaped |= bool((gauges(info["error_shape"], info["estimation_error"].T) > 1.0).any())
        alarms += int(info["assumption_violated"].sum())
        reasons |= set(info["shield_reason"].tolist())
        # An alarm ends the proof at once; without one the flag cannot know what no packet showed.
        assert not (info["shield_guaranteed"] & info["assumption_violated"]).any()
        assert (np.abs(info["input"]) <= plant.u_max).all()
    assert escaped
    assert alarms > 0
    assert ALARM in reasons


# Of a plant without memory, with inputs of no effect: a draw that leaves its ellipsoid by a few percent leaves S.
DELTA, STEPS, COUNT = 2e-3, 100, 1000


def tight_plant(delta):
    """A plant whose safe box is 2 % wider than the bound that a level delta gives to its noise."""
    declared = {"u_max": 1.0, "dt": 0.1, "process_noise_cov": [[0.1]], "sensor_bound": 1e-3, "initial_bound": 1e-3}
    declared |= {"A": [[0.01]], "B": [[1e-3]], "delta": delta}
    radius = np.sqrt(linear_plant(box=[1.0], **declared).disturbance.shape_matrix[0, 0])
    return linear_plant(box=[1.02 * radius], **declared)


@cache
def share_of_exits(delta, noise):
    """The share of episodes whose state leaves S, under random proposals; episodes begin in S."""
    plant = tight_plant(delta)
    certificate = certificate_of(plant)
    env = vector_env(COUNT, plant=plant, channel=Channel(loss=0.3), noise=noise, max_episode_steps=None)
    shield, rng = vector_shield(env, certificate), np.random.default_rng(0)
    _, info = shield.reset(seed=0)
    assert info["shield_guaranteed"].all()
    outside = np.zeros(COUNT, np.bool_)
    for _ in range(STEPS):
        *_, info = shield.step(rng.uniform(-1.0, 1.0, (COUNT, plant.m)).astype(np.float32))
        outside |= np.einsum("ki,ij,kj->k", info["state"], metric(certificate), info["state"]) > 1.0
    return outside.mean()


@pytest.mark.slow
def test_share_of_episodes_that_leave_the_safe_set_is_below_the_union_bound_and_close_to_it():
    bound = bound_violation_probability(tight_plant(DELTA), Channel(loss=0.3), STEPS)
    assert bound == pytest.approx(STEPS * DELTA)  # nothing but the process noise is Gaussian
    assert 0.5 * bound < share_of_exits(DELTA, "gaussian") <= bound
    assert share_of_exits(DELTA, "truncated") == 0.0


@pytest.mark.slow
def test_a_smaller_delta_makes_leaving_rarer():
    shares = [share_of_exits(delta, "gaussian") for delta in (DELTA, DELTA / 20.0)]
    assert 0.0 < shares[1] < 0.2 * shares[0]
