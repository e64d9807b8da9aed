"""Curricula: what would have no effect is refused, and what has one has the same one everywhere."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from agents import SB3VecEnv
from agents.loop import CostPenalty
from ncs_gym import (
    Channel,
    RequestActions,
    VectorNetworked,
    VectorRandomChannel,
)
from tests.product import safety_shield, vector_shield

ID, CLASSIC = "ncs_gym/TruckTrailerCruise-v0", "CartPole-v1"
ASKS = {"channel": Channel(on_request=True, max_consecutive_losses=1)}


def shield():
    return safety_shield(gym.make(ID))


def shields():
    return vector_shield(gym.make_vec(ID, num_envs=2))


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_what_is_drawn_from_changes_for_episodes_that_begin_by_themselves_and_infos_of_their_starts_say_so(mode):
    envs = gym.make_vec(ID, num_envs=2, max_episode_steps=4, autoreset_mode=mode)
    draws = VectorRandomChannel(envs, [Channel(loss=0.1)])
    env = SB3VecEnv(draws, info_keywords=("channel_loss",))
    env.seed(0)
    env.reset()
    draws.draw_from(lambda rng: {"loss": 0.5})
    seen = []
    for _ in range(13):
        observation, _, _, infos = env.step(np.zeros((2, 1), np.float32))
        seen.append(infos[1]["channel_loss"])
        if "episode" in infos[1]:
            assert env.reset_infos[1]["channel_loss"] == 0.5
            np.testing.assert_allclose(observation[1][:2], env.reset_infos[1]["estimate"], rtol=1e-6)
    assert seen == [0.1] * 4 + [0.5] * 9
    with pytest.raises(AttributeError, match=r"use vec_env\.vector_env"):
        env.env_method("draw_from", [Channel()])


def test_specification_of_vector_wrappers_makes_no_environments_without_them():
    envs = gym.make_vec(ID, num_envs=2)
    for other in (gym.make_vec(CLASSIC, num_envs=2), gym.make_vec(ID, num_envs=2, vectorization_mode="sync")):
        with pytest.raises(ValueError, match="VectorRandomChannel is for an NCSVectorEnv"):
            VectorRandomChannel(other, [Channel()])
    made_of = [
        vector_shield(gym.make_vec(ID, num_envs=2)),
        VectorRandomChannel(envs, [Channel()]),
        CostPenalty(envs, 1.0),
    ]
    made_of.append(VectorNetworked(gym.make_vec("CartPole-v1", 2, vectorization_mode="sync"), Channel(delay=1)))
    for env in made_of:
        assert env.spec.additional_wrappers[-1].name == type(env).__name__
        assert not env.unwrapped.spec.additional_wrappers
        with pytest.raises((gym.error.Error, ValueError)):
            gym.make_vec(env.spec)


@pytest.mark.parametrize(
    ("make", "name"),
    [(lambda: RequestActions(gym.make(ID, **ASKS), cost=0.1), "cost"), (shield, "penalty"), (shields, "penalty")],
)
def test_prices_of_wrappers_may_change_and_are_those_of_their_specs(make, name):
    env = make()
    for price in (getattr(env, name), 0.5):
        setattr(env, name, price)
        assert getattr(env, name) == price
        assert make is shields or getattr(gym.make(env.spec), name) == price
    with pytest.raises(ValueError, match=f"{name} must be a number >= 0"):
        setattr(env, name, -3.0)
    assert getattr(env, name) == 0.5
