"""Wrappers whose actions ask for samples."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ncs_gym import Channel, ChannelContract, RequestActions, VectorRequestActions, cart_pole
from tests.certificates import certificate_of
from tests.product import safety_shield, vector_shield

ID, COST = "ncs_gym/CartPole-v0", 0.25
CHANNEL = Channel(0.5, delay=1, max_consecutive_losses=1, quantization_step=1e-4, on_request=True)
CONTRACT = ChannelContract(4, 1e-4)
SETTINGS = {"channel": CHANNEL, "contract": CONTRACT, "terminate_on_violation": False}


def shielded():
    return RequestActions(safety_shield(gym.make(ID, **SETTINGS), certificate_of(cart_pole(), CONTRACT)), COST)


def test_gymnasiums_checker_accepts_it():
    env = gym.make(ID, **SETTINGS).unwrapped
    check_env(RequestActions(env, COST), skip_render_check=True)


def test_last_entry_asks_and_every_packet_costs():
    env, plain = shielded(), shielded().env
    observation, info = env.reset(seed=0)
    plain.reset(seed=0)
    assert env.observation_space.contains(observation)
    rng, packets, forced = np.random.default_rng(0), 0, 0
    for _ in range(80):
        action = rng.uniform(-1.0, 1.0, 2).astype(np.float32)
        action[-1] -= 0.8
        plain.unwrapped.request(bool(action[-1] > 0.0))
        expected, reward_without, *_ = plain.step(action[:1])
        observation, reward, *_, info = env.step(action)
        assert env.observation_space.contains(observation)
        np.testing.assert_array_equal(observation[:-2], expected)
        assert observation[-2:].tolist() == [info["measurement_age"], env.unwrapped.outstanding]
        assert reward == pytest.approx(reward_without - COST * (info["packets"] - packets))
        packets, forced = info["packets"], forced + info["request_forced"]
        assert action[-1] <= 0.0 or info["requested"]
    assert 0 < forced < packets < 80


def test_vector_wrapper_does_what_the_scalar_one_does():
    envs = gym.make_vec(ID, num_envs=6, max_episode_steps=20, **SETTINGS)
    envs = VectorRequestActions(vector_shield(envs, certificate_of(cart_pole(), CONTRACT)), COST)
    observations, _ = envs.reset(seed=0)
    assert envs.observation_space.contains(observations)
    rng, before = np.random.default_rng(0), np.zeros(6)
    for step in range(1, 50):
        actions = rng.uniform(-1.0, 1.0, (6, 2)).astype(np.float32)
        observations, _, _, truncated, info = envs.step(actions)
        assert envs.observation_space.contains(observations)
        np.testing.assert_array_equal(observations[:, -2], info["measurement_age"])
        np.testing.assert_array_equal(observations[:, -1], envs.unwrapped.outstanding)
        begins = step % 21 == 0
        assert truncated.all() == (step % 21 == 20)
        np.testing.assert_array_equal(info["requested"] & begins, np.zeros(6))
        assert (info["requested"] >= (actions[:, -1] > 0.0) & (not begins)).all()
        before = info["packets"]
    assert before.max() < 20  # counted anew in every episode


def test_vector_wrapper_subtracts_the_cost_of_each_packet():
    def rewards(cost):
        envs = VectorRequestActions(gym.make_vec(ID, num_envs=6, max_episode_steps=20, **SETTINGS), cost)
        envs.reset(seed=0)
        found = [envs.step(np.tile([[0.0, (-1.0) ** step]], (6, 1)))[1::3] for step in range(45)]
        return np.array([reward for reward, _ in found]), np.array([info["packets"] for _, info in found])

    free, packets = rewards(0.0)
    paid, _ = rewards(COST)
    sent = np.maximum(np.diff(packets, axis=0, prepend=np.zeros((1, 6))), 0)
    np.testing.assert_allclose(free - paid, COST * sent, atol=1e-12)
    assert sent.sum() > 60
