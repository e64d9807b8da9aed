"""Gymnasium's and stable-baselines3's own wrappers around and inside shields."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector

from tests.product import safety_shield, vector_shield

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
SOME = 40

SCALAR = {
    "NormalizeObservation": wrappers.NormalizeObservation,
    "RescaleObservation": lambda env: wrappers.RescaleObservation(env, np.float32(-1.0), np.float32(1.0)),
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 2),
}
VECTOR = {
    "NormalizeObservation": vector.NormalizeObservation,
    "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
}


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


@pytest.fixture(scope="module")
def shielded(certificate):
    return play(safety_shield(gym.make(CRUISE), certificate, penalty=0.5), SOME, 1)


@pytest.mark.cases(4)
@pytest.mark.parametrize("order", ["outside", "inside"])
@pytest.mark.parametrize("name", SCALAR)
def test_wrappers_change_no_decision_on_either_side_of_the_shield(name, order, shielded, certificate):
    if order == "outside":
        env = SCALAR[name](safety_shield(gym.make(CRUISE), certificate, penalty=0.5))
    else:
        env = safety_shield(SCALAR[name](gym.make(CRUISE)), certificate, penalty=0.5)
    wrapped = play(env, SOME, 1)
    assert shielded[2][-1]["episode_interventions"] > 0
    assert wrapped[2][-1]["shield_guaranteed"]
    np.testing.assert_array_equal(shielded[1], wrapped[1])
    assert_same_infos(shielded[2], wrapped[2])


@pytest.mark.cases(3)
@pytest.mark.parametrize("order", ["bare", "outside", "inside"])
@pytest.mark.parametrize("name", VECTOR)
def test_vector_wrappers_change_neither_seeds_nor_infos_nor_decisions(name, order, certificate):
    count = 3

    def make(wrap):
        env = gym.make_vec(CRUISE, num_envs=count, max_episode_steps=20)
        if order == "bare":
            return wrap(env)
        if order == "outside":
            return wrap(vector_shield(env, certificate, penalty=0.5))
        return vector_shield(wrap(env), certificate, penalty=0.5)

    plain, wrapped = play(make(lambda env: env), 45, count, 1), play(make(VECTOR[name]), 45, count, 1)
    np.testing.assert_array_equal(plain[1], wrapped[1])
    assert_same_infos(plain[2], wrapped[2])
    if order != "bare":
        assert sum(info["shield_intervened"].sum() for info in wrapped[2]) > 0
        assert all(info["shield_guaranteed"].all() for info in wrapped[2])
