"""Gymnasium's and stable-baselines3's own wrappers around and inside shields."""

from functools import reduce

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector

from tests.product import safety_shield, vector_shield

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
SOME = 40

SCALAR = [
    lambda env: wrappers.RescaleObservation(env, np.float32(-1.0), np.float32(1.0)),
    wrappers.NormalizeObservation,
    wrappers.RecordEpisodeStatistics,
    lambda env: wrappers.FrameStackObservation(env, 3),
    lambda env: wrappers.DelayObservation(env, 2),
]
VECTOR = [vector.NormalizeObservation, vector.RecordEpisodeStatistics]


def inside(env, makes):
    """An environment inside of all wrappers."""
    return reduce(lambda inner, make: make(inner), makes, env)


def actions(*shape):
    """Random, with a preference for full throttle: a shield has to act."""
    return np.clip(np.random.default_rng(0).normal(0.8, 0.6, shape), -1.0, 1.0).astype(np.float32)


def play(env, steps, *shape):
    """One run from a fixed seed: observations, rewards and infos."""
    observation, info = env.reset(seed=3)
    seen, rewards, infos = [observation], [], [info]
    for action in actions(steps, *shape):
        observation, reward, _, _, info = env.step(action)
        seen.append(observation)
        rewards.append(reward)
        infos.append(info)
    return np.array(seen), np.array(rewards), infos


def assert_same_infos(ones, others):
    for one, other in zip(ones, others, strict=True):
        assert one.keys() <= other.keys()
        for key in one.keys() - {"episode", "_episode"}:
            np.testing.assert_array_equal(one[key], other[key], err_msg=key)


def shielded(env, certificate):
    return (safety_shield if isinstance(env, gym.Env) else vector_shield)(env, certificate, penalty=0.5)


@pytest.mark.parametrize(
    ("make", "makes", "shape"),
    [
        (lambda: gym.make(CRUISE), SCALAR, (1,)),
        (lambda: gym.make_vec(CRUISE, num_envs=3, max_episode_steps=20), VECTOR, (3, 1)),
    ],
)
def test_wrappers_on_either_side_of_the_shield_change_neither_seeds_nor_infos_nor_decisions(
    make, makes, shape, certificate
):
    _, rewards, infos = play(shielded(make(), certificate), SOME, *shape)
    assert np.sum([info["shield_intervened"] for info in infos[1:]]) > 0
    for env in (inside(shielded(make(), certificate), makes), shielded(inside(make(), makes), certificate)):
        _, others, wrapped = play(env, SOME, *shape)
        np.testing.assert_array_equal(rewards, others)
        assert_same_infos(infos, wrapped)
        assert np.all([info["shield_guaranteed"] for info in wrapped])
