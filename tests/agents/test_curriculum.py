"""Curricula: what would have no effect is refused, and what has one has the same one everywhere."""

import pickle
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from agents import SB3VecEnv
from agents.loop import BasePolicy, CostPenalty, ResidualActions
from ncs_gym import (
    Channel,
    Networked,
    RandomChannel,
    RequestActions,
    VectorNetworked,
    VectorRandomChannel,
    VectorRequestActions,
)
from ncs_gym.validation import require_not_inside
from shields import SafetyShield, VectorSafetyShield

ID, CLASSIC = "ncs_gym/TruckTrailerCruise-v0", "CartPole-v1"
ASKS = {"channel": Channel(on_request=True, max_consecutive_losses=1)}


def shield():
    return SafetyShield(gym.make(ID))


def shields():
    return VectorSafetyShield(gym.make_vec(ID, num_envs=2))


# Our wrappers around environments, each with what only something inside has.
WRAPPED = {
    "shield": (shield, ("channel", "disturbance", "plant", "steps", "episode_channel")),
    "random": (lambda: RandomChannel(shield(), [Channel()]), ("channel", "downlink", "penalty", "certificate")),
    "requests": (lambda: RequestActions(gym.make(ID, **ASKS)), ("channel", "noise", "task")),
    "network": (
        lambda: Networked(gym.make(CLASSIC)),
        ("channel", "downlink", "gravity", "delay_reward", "fill", "late", "idle", "neutral", "observe", "pending"),
    ),
    "around": (lambda: RandomChannel(Networked(gym.make(CLASSIC)), [Channel()]), ("channel", "downlink", "gravity")),
    "networks": (
        lambda: VectorNetworked(gym.make_vec(CLASSIC, num_envs=2)),
        ("channel", "downlink", "gravity", "delay_reward", "fill"),
    ),
    "shields": (shields, ("channel", "disturbance", "rendered_env")),
    "randoms": (lambda: VectorRandomChannel(shields(), [Channel()]), ("channel", "penalty")),
    "asking": (lambda: VectorRequestActions(gym.make_vec(ID, num_envs=2, **ASKS)), ("channel", "noise")),
    "penalty": (lambda: CostPenalty(shields(), 1.0), ("channel", "certificate")),
    "residual": (lambda: ResidualActions(shields(), BasePolicy(np.zeros((1, 2)))), ("channel", "initial_set")),
    "adapter": (lambda: SB3VecEnv(shields()), ("channel", "disturbance", "penalty", "certificate")),
}


@pytest.mark.parametrize("kind", WRAPPED)
def test_what_only_something_inside_has_is_not_set_on_a_wrapper(kind):
    make, names = WRAPPED[kind]
    env = make()
    for each in (env, pickle.loads(pickle.dumps(env))):
        for name in names:
            with pytest.raises(
                AttributeError, match=r"and cannot be changed|set on \w+ it would have no effect"
            ) as refused:
                setattr(each, name, 1)
            assert name not in vars(each)
            assert (name in ("channel", "downlink")) == ("episodes get other ones" in str(refused.value))
            if name in ("channel", "downlink"):
                assert f'reset(options={{"{name}": ...}})' in str(refused.value)
        each.my_own_mark = 3
        assert each.my_own_mark == 3
    if kind == "adapter":
        with pytest.raises(AttributeError, match="episodes get other ones by RandomChannel"):
            env.set_attr("channel", Channel())
        with pytest.raises(AttributeError, match="penalty belongs to the VectorSafetyShield inside"):
            VecNormalize(env).set_attr("penalty", 3.0)
    if kind == "penalty":  # which algorithms with multipliers change
        env.penalty = 2.0
        assert env.penalty == 2.0
        assert env.env.penalty == 0.0


@pytest.mark.parametrize("name", ["channel", "downlink", "fill", "late", "draws"])
def test_what_a_wrapper_of_vector_environments_has_is_not_set_on_the_environments_inside(name):
    inner = gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync")
    networked = VectorNetworked(inner, Channel(delay=1))
    env = SB3VecEnv(VectorRandomChannel(networked, [Channel(delay=1)]))
    if name == "draws":
        env.set_attr(name, 3)  # nobody has it: it is the environments' own
        assert env.get_attr(name) == [3, 3]
        return
    with pytest.raises(AttributeError, match=r"and cannot be changed|it would have no effect"):
        env.set_attr(name, Channel(delay=4))
    assert env.get_attr(name) == [getattr(networked, name)] * 2


def test_layers_that_do_not_lead_to_the_last_one_come_to_an_end():
    require_not_inside("mark", SimpleNamespace(env=SimpleNamespace()), "outside", until=object())


def test_stable_baselines3_sets_no_channel_on_a_shield_and_asks_through_its_monitor():
    shielded = DummyVecEnv([lambda: SafetyShield(gym.make(ID))])
    with pytest.raises(AttributeError, match="episodes get other ones by RandomChannel"):
        shielded.set_attr("channel", Channel(loss=0.5))
    monitored = DummyVecEnv([lambda: Monitor(gym.make(ID))])
    with pytest.raises(AttributeError, match="episodes get other ones by RandomChannel"):
        monitored.env_method("set_wrapper_attr", "channel", Channel(loss=0.5))


def test_channel_of_an_option_lasts_one_episode_under_stable_baselines3_alone_and_under_our_adapter():
    def episodes(env):
        env.set_options({"channel": Channel(loss=0.5, delay=4)})
        env.reset()
        seen = [env.reset_infos[0]]
        for _ in range(9):
            *_, done, infos = env.step(np.zeros((2, 1), np.float32))
            if done.all():
                assert infos[0]["channel_loss"] == seen[-1]["channel_loss"]
                seen.append(env.reset_infos[0])
        return [(info["channel_loss"], info["channel_delay"]) for info in seen]

    made = {"max_episode_steps": 3, "channel": Channel(loss=0.3, delay=1)}
    theirs = episodes(DummyVecEnv([lambda: gym.make("ncs_gym/TruckTrailer-v0", **made)] * 2))
    assert theirs == [(0.5, 4), (0.3, 1), (0.3, 1), (0.3, 1)]
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
        vector = gym.make_vec("ncs_gym/TruckTrailer-v0", num_envs=2, autoreset_mode=mode, **made)
        assert episodes(SB3VecEnv(vector, info_keywords=("channel_loss",))) == theirs


@pytest.mark.parametrize("kind", ["SubprocVecEnv", "AsyncVectorEnv"])
def test_what_is_drawn_from_changes_in_worker_processes_too(kind):
    makes = [lambda: RandomChannel(gym.make(ID), [Channel(loss=0.1)])] * 2
    if kind == "AsyncVectorEnv":
        envs = gym.vector.AsyncVectorEnv(makes)
        say, losses = envs.call, lambda: envs.reset(seed=0)[1]["channel_loss"].tolist()
    else:
        envs = SubprocVecEnv(makes, "fork")
        say, losses = envs.env_method, lambda: envs.reset() is None or [i["channel_loss"] for i in envs.reset_infos]
    try:
        assert losses() == [0.1, 0.1]
        say("draw_from", [Channel(loss=0.5)])
        assert losses() == [0.5, 0.5]
    finally:
        envs.close()


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
    with pytest.raises(ValueError, match="takes the place of what was given: give channel"):
        draws.draw_from(downlink=[Channel()])
    with pytest.raises(AttributeError, match=r"call vec_env\.vector_env\.draw_from"):
        env.env_method("draw_from", [Channel()])


def test_specification_of_vector_wrappers_makes_no_environments_without_them():
    envs = gym.make_vec(ID, num_envs=2)
    for other in (gym.make_vec(CLASSIC, num_envs=2), gym.make_vec(ID, num_envs=2, vectorization_mode="sync")):
        with pytest.raises(ValueError, match=r"VectorRandomChannel is for an NCSVectorEnv.* take RandomChannel around"):
            VectorRandomChannel(other, [Channel()])
    made_of = [VectorSafetyShield(envs), VectorRandomChannel(envs, [Channel()]), CostPenalty(envs, 1.0)]
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


def test_what_random_channels_draw_from_is_that_of_their_spec():
    env = RandomChannel(gym.make(ID), [Channel(loss=0.1)])
    assert gym.make(env.spec).reset(seed=0)[1]["channel_loss"] == 0.1
    env.draw_from([Channel(loss=0.5)])
    assert gym.make(env.spec).reset(seed=0)[1]["channel_loss"] == 0.5
