"""An environment made with settings given as JSON values is made again from its spec, and moves alike."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import ncs_gym

IDS = ("TruckTrailer-v0", "TruckTrailerCruise-v0", "CartPole-v0", "BatchReactor-v0")


def settings(plant, channel):
    """A value of every setting for a plant, as JSON has it."""
    step = channel.quantization_step
    return {
        "channel": {"loss": 0.1, "quantization_step": step, "max_consecutive_losses": 2},
        "contract": {"max_age": 4, "quantization_step": step},
        "task": {"output": [1.0] + [0.0] * (plant.n - 1), "reach": 0.8, "width": 1.0, "change_probability": 0.1},
        "disturbance": "sphere",
        "initial_set": {"shape": (1e-4 * np.eye(plant.n)).tolist()},
        "terminate_on_violation": True,
        "allow_assumption_violation": True,
        "noise": "gaussian",
        "horizon": 100,
    }


def run(env):
    """Observations and rewards of some steps with the largest input."""
    seen = [env.reset(seed=3)[0]]
    for _ in range(20):
        observation, reward, terminated, *_ = env.step(np.ones(env.action_space.shape, np.float32))
        seen += [observation, np.array([reward])]
        if terminated:
            break
    return np.concatenate(seen)


@pytest.mark.parametrize("env_id", IDS)
def test_every_json_setting_survives_the_spec(env_id):
    own = gym.make(f"ncs_gym/{env_id}").unwrapped
    for name, value in settings(own.plant, own.channel).items():
        env = gym.make(f"ncs_gym/{env_id}", **{name: value})
        again = gym.make(EnvSpec.from_json(env.spec.to_json()))
        assert again.spec.kwargs[name] == value
        np.testing.assert_array_equal(run(again), run(env), err_msg=name)


def test_a_setting_that_is_an_object_survives_the_spec():
    env = gym.make("ncs_gym/TruckTrailerCruise-v0", task=ncs_gym.SpeedTracking(fastest=5.0))
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.task.fastest == 5.0
    np.testing.assert_array_equal(run(again), run(env))
