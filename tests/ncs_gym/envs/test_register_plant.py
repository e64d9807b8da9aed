"""Plants of users' own as registered environments, and settings as JSON values."""

import json

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from ncs_gym import (
    Channel,
    ChannelContract,
    GilbertElliott,
    NCSVectorEnv,
    Regulation,
    SpeedTracking,
    truck_trailer,
)
from ncs_gym.registration import registered_ids

TRUCK = "ncs_gym/TruckTrailer-v0"
BURSTS = GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5)


def episode_length(env):
    env.reset(seed=0)
    steps, over = 0, False
    while not over:
        *_, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
        steps, over = steps + 1, terminated or truncated
    return steps


def test_registered_plant_is_made_with_its_settings_and_time_limit(register):
    plant = truck_trailer(mass=2000.0)
    register("Plants/Truck-v0", plant, channel=Channel(loss=0.2), task=SpeedTracking(), max_episode_steps=7)
    env = gym.make("Plants/Truck-v0")
    inner = env.unwrapped
    assert inner.plant is plant
    assert (inner.channel, type(inner.task), inner.horizon) == (Channel(loss=0.2), SpeedTracking, 7)
    assert episode_length(env) == 7
    assert "Plants/Truck-v0" in registered_ids()


def test_registered_plant_has_a_vector_environment_of_its_own(register):
    plant = truck_trailer(mass=2000.0)
    register("Plants/Truck-v0", plant, max_episode_steps=3)
    envs = gym.make_vec("Plants/Truck-v0", num_envs=4)
    assert isinstance(envs, NCSVectorEnv)
    assert envs.plant is plant
    envs.reset(seed=0)
    truncated = [envs.step(np.zeros((4, 1), np.float32))[3].all() for _ in range(3)]
    assert truncated == [False, False, True]


def test_spec_of_a_plant_s_file_is_json(register, tmp_path):
    plant = truck_trailer(mass=2000.0)
    plant.save(tmp_path / "plant.json")
    register("Plants/Truck-v0", tmp_path / "plant.json", channel=Channel(loss=BURSTS), contract=ChannelContract(9))
    env = gym.make(EnvSpec.from_json(gym.spec("Plants/Truck-v0").to_json())).unwrapped
    assert env.plant.fingerprint == plant.fingerprint
    assert (env.channel, env.contract) == (Channel(loss=BURSTS), ChannelContract(9))


@pytest.mark.parametrize(
    "settings",
    [
        {"channel": Channel(loss=0.1, quantization_step=0.01, delay=1, jitter=2, max_consecutive_losses=3)},
        {"channel": Channel(loss=BURSTS)},
        {"channel": {"loss": {"p_good_to_bad": 0.1, "p_bad_to_good": 0.5}, "delay": 3}},
        {"channel": {"loss": 0.2, "max_consecutive_losses": 1, "on_request": True}, "contract": {"max_age": 6}},
        {"downlink": Channel(loss=BURSTS, delay=1, max_consecutive_losses=3), "downlink_contract": ChannelContract(5)},
        {"noise": "gaussian"},
        {"channel": Channel(max_consecutive_losses=1), "contract": ChannelContract(max_age=5)},
        {"contract": {"max_age": 5}, "channel": {}},
        {"task": SpeedTracking(fastest=10.0)},
        {"task": {"output": [1.0, 0.0], "reach": 0.8, "width": 0.5}},
        {"task": Regulation()},
        {"disturbance": "sphere"},
        {"disturbance": {"half_widths": [0.01, 0.01]}},
        {"disturbance": {"period": 7.0}},
        {"initial_set": {"shape_matrix": [[1.0, 0.0], [0.0, 2.0]]}},
        {"terminate_on_violation": True, "allow_assumption_violation": True, "horizon": 50},
    ],
    ids=str,
)
def test_environment_of_a_loaded_spec_behaves_as_the_one_it_was_saved_of(settings):
    made = gym.make(TRUCK, **settings)
    text = made.spec.to_json()
    loaded = gym.make(EnvSpec.from_json(text))
    assert json.loads(loaded.spec.to_json()) == json.loads(text)
    assert (loaded.unwrapped.channel, loaded.unwrapped.contract) == (made.unwrapped.channel, made.unwrapped.contract)
    for name in ("terminate_on_violation", "downlink", "downlink_contract", "noise", "horizon"):
        assert getattr(loaded.unwrapped, name) == getattr(made.unwrapped, name)
    for envs in (made, loaded):
        envs.reset(seed=3)
    for step in range(30):
        action = np.array([np.sin(step)], np.float32)
        (first, reward, *_), (second, same_reward, *_) = made.step(action), loaded.step(action)
        np.testing.assert_array_equal(first, second)
        assert reward == same_reward
    vector = gym.make_vec(EnvSpec.from_json(text), num_envs=2)
    assert isinstance(vector, NCSVectorEnv)
    assert vector.channel == made.unwrapped.channel
