"""Regulators that know that a disturbance persists: what they estimate, and that no offset remains."""

import gymnasium as gym
import numpy as np
import pytest

from experiments.baselines.controllers import RegulatorWeights, controller
from experiments.baselines.observer import DisturbanceObserver
from experiments.runs.policies import policy_by_name
from ncs_gym import Channel, SetpointTracking
from shields.certificate import Fallback
from tests.product import gym_vector_env, linear_plant, loop_env

WEIGHTS, PUSH = RegulatorWeights(0.1, 0.01, 0.2), np.array([0.012, -0.008])
# A stable plant and one that integrates, each with a push that its input can hold its first state against.
PLANTS = {"stable": [[0.9, 0.1], [0.0, 0.8]], "integrating": [[1.0, 0.1], [0.0, 0.9]]}
NETWORKS = {
    "ideal": {},
    "lossy": {"channel": Channel(loss=0.4, delay=1, max_consecutive_losses=2)},
    "both ways": {
        "channel": Channel(loss=0.4, delay=1, max_consecutive_losses=2),
        "downlink": Channel(loss=0.3, delay=1, max_consecutive_losses=1),
    },
}


def calm(A, **settings):
    """A loop whose only disturbance is a push that stays, and whose sensor is as good as exact."""
    plant = linear_plant(
        A=A, B=[[0.05], [0.1]], dt=1.0, box=[1.0, 1.0], u_max=2.0, disturbance_bound=[0.02, 0.02],
        sensor_bound=1e-6, initial_bound=1e-6,
    )  # fmt: skip
    task = SetpointTracking(output=np.array([1.0, 0.0]), reach=0.2, width=0.2, change_probability=0.0)
    return loop_env(plant=plant, task=task, disturbance=lambda rng, plant, nominal_next: PUSH, horizon=500, **settings)


def fallback(env):
    return Fallback.of_gain(np.zeros((env.plant.m, env.plant.n)))


def offset(env, name, steps=250):
    """How far the output is from its target in the mean of the last steps, in units of the target's range."""
    policy, (observation, info) = controller(name, env, fallback(env), 0, WEIGHTS), env.reset(seed=0)
    errors = []
    for _ in range(steps):
        action = policy(observation[None], {key: np.asarray(each)[None] for key, each in info.items()})[0]
        observation, *_, info = env.step(action)
        errors.append(info["state"][0] - observation[env.plant.n])
    return abs(np.mean(errors[-50:])) / 0.2


@pytest.mark.cases(2)
@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", ["lqr", "mpc"])
def test_a_push_that_stays_leaves_an_offset_only_without_the_observer(name, plant, network):
    env = calm(PLANTS[plant], **NETWORKS[network])
    assert offset(env, name) > 0.05
    assert offset(env, f"{name}:observer") < 2e-3


def test_estimates_stay_within_the_bound_and_begin_anew_with_an_episode():
    plant = calm(PLANTS["stable"]).plant
    envs = gym_vector_env(2, plant=plant, max_episode_steps=30)
    observer, (_, infos) = DisturbanceObserver(envs.unwrapped.single, 1.0), envs.reset(seed=0)
    largest = np.sqrt(np.diag(plant.nominal_disturbance.shape_matrix))
    for step in range(32):
        _, d = observer.see(infos)
        assert (d != 0.0).any() == (step not in (0, 31))
        assert (np.abs(d) <= largest).all()
        *_, infos = envs.step(np.zeros((2, 1), np.float32))
    infos["estimate"] = infos["estimate"] + 0.5
    np.testing.assert_allclose(np.abs(observer.see(infos)[1]), np.tile(largest, (2, 1)))


def test_a_single_environment_is_observed_like_many():
    env_id = "ncs_gym/CSTR-v0"
    env = gym.make(env_id)
    policy, (observation, info) = policy_by_name("lqr:observer", env_id, env.unwrapped, 0), env.reset(seed=0)
    plain = policy_by_name("lqr", env_id, env.unwrapped, 0)
    differ = 0.0
    for _ in range(20):
        action = policy(observation, info)
        differ = max(differ, np.abs(action - plain(observation, info)).max())
        assert env.action_space.contains(action)
        observation, *_, info = env.step(action)
    assert differ > 1e-3
