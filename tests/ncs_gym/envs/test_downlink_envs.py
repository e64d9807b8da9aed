"""Environments whose commands are late or lost: scalar ones, vectors, and that both are the same."""

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, GilbertElliott, SpeedTracking, truck_trailer
from tests.ncs_gym.envs.same_draws import compare
from tests.product import loop_env, vector_env

BURSTS = GilbertElliott(p_good_to_bad=0.2, p_bad_to_good=0.3, loss_good=0.05, loss_bad=0.9)
DOWNLINKS = {
    "one late": Channel(delay=1),
    "losses": Channel(loss=0.5, max_consecutive_losses=2),
    "overtaking": Channel(loss=0.3, delay=1, jitter=3, max_consecutive_losses=1),
    "bursts": Channel(loss=BURSTS, delay=1, max_consecutive_losses=3),
    "no contract": Channel(loss=BURSTS, jitter=2),
}
CRUISE = {"plant": truck_trailer(mass=4000.0), "task": SpeedTracking(change_probability=0.2)}
UPLINK = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", DOWNLINKS)
def test_vector_equals_scalar_environment(name):
    compare(vector_env(3, channel=UPLINK, downlink=DOWNLINKS[name], **CRUISE), 100)


@pytest.mark.cases(1)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vector_episodes_that_begin_anew_equal_scalar_ones(mode):
    channel = Channel(loss=0.2, quantization_step=0.02, delay=1, jitter=4)
    settings = CRUISE | {"channel": channel, "downlink": DOWNLINKS["bursts"], "terminate_on_violation": True}
    env = vector_env(4, max_episode_steps=41, autoreset_mode=mode, **settings)
    compare(env, 100)
    assert env.episodes.min() >= 3


@pytest.mark.cases(3)
@pytest.mark.parametrize("name", DOWNLINKS)
def test_actuator_applies_what_was_committed_and_zero_only_when_the_downlink_is_broken(name):
    env = loop_env(downlink=DOWNLINKS[name], **CRUISE)
    input_delay = env.downlink_protocol.input_delay
    _, info = env.reset(seed=0)
    committed, missing = [], 0
    rng = np.random.default_rng(0)
    for k in range(300):
        *_, info = env.step(rng.uniform(-1, 1, 1))
        committed.append(info["input_committed"])
        scheduled = committed[k - input_delay] if k >= input_delay else np.zeros(1)
        missing += info["downlink_broken"]
        np.testing.assert_array_equal(info["input"], 0.0 if info["downlink_broken"] else scheduled)
    assert (missing > 0) == (env.downlink_protocol.contract is None)


def test_estimate_is_the_prediction_with_the_committed_inputs_and_its_error_stays_in_its_shape():
    env = loop_env(channel=UPLINK, downlink=DOWNLINKS["overtaking"], disturbance="sphere", **CRUISE)
    input_delay, plant = env.downlink_protocol.input_delay, env.plant
    _, info = env.reset(seed=0)
    rng, infos, committed, worst = np.random.default_rng(1), [info], [np.zeros(1)] * input_delay, 0.0
    for _ in range(400):
        info = env.step(rng.uniform(-1, 1, 1))[4]
        infos.append(info)
        committed.append(info["input_committed"])
    for k, info in enumerate(infos[: len(infos) - input_delay]):
        predicted = info["state"] + info["estimation_error"]
        for u in committed[k : k + input_delay]:
            predicted = plant.A @ predicted + plant.B @ u
        np.testing.assert_allclose(info["estimate"], predicted, atol=1e-12)
        error = info["estimate"] - infos[k + input_delay]["state"]
        worst = max(worst, error @ np.linalg.solve(info["error_shape"], error))
    assert 0.3 < worst <= 1.0


def test_observation_holds_the_prediction_and_what_is_known_of_the_task_by_then():
    env = loop_env(downlink=Channel(delay=2), **(CRUISE | {"task": SpeedTracking(change_probability=0.0)}))
    before, _ = env.reset(seed=0)
    for action in (1.0, -0.5, 0.25, 0.75, 0.0, 0.0):
        observation, *_, info = env.step(np.array([action]))
        np.testing.assert_allclose(observation[:2], info["estimate"], rtol=1e-6)
        gained = env.plant.dt * info["input_committed"][0]  # of the speed, two steps later
        np.testing.assert_allclose(observation[2], before[2] - gained, rtol=1e-5)
        before = observation


def test_certificates_rest_on_both_contracts():
    env = gym.make("ncs_gym/CartPole-v0", downlink=Channel(loss=0.2, delay=1, max_consecutive_losses=1)).unwrapped
    assert env.contract == ChannelContract(4, 1e-4)
    assert env.downlink_protocol.contract == ChannelContract(2)
    assert env.certificate_contract == env.error_set.contract == ChannelContract(6, 1e-4)
    assert loop_env(downlink=Channel(delay=2), **CRUISE).certificate_contract is None


def test_a_contract_that_the_downlink_may_break_is_kept_until_it_does():
    env = loop_env(downlink=Channel(loss=0.5), downlink_contract=ChannelContract(2), **CRUISE)
    assert env.downlink_protocol.input_delay == 2
    env.reset(seed=0)
    broken = [env.step(np.ones(1))[4]["downlink_broken"] for _ in range(200)]
    assert 5 < sum(broken) < 60  # three losses in a row: an eighth of the steps
