"""Channels of single episodes, and of each environment of a vector: equal, refused where they do not fit, and drawn."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from ncs_gym import (
    Channel,
    ChannelContract,
    GilbertElliott,
    Networked,
    RandomChannel,
    SpeedTracking,
    VectorNetworked,
    VectorRandomChannel,
    truck_trailer,
)
from tests.ncs_gym.envs.same_draws import compare
from tests.ncs_gym.networked.environments import Sampled
from tests.product import loop_env, vector_env

PLANT = truck_trailer(mass=4000.0)
BURSTS = GilbertElliott(p_good_to_bad=0.2, p_bad_to_good=0.3)
# Each draws as many numbers per step, so that scalar environments can be fed with those of a vector.
LATE = [Channel(loss=0.3, delay=delay, quantization_step=0.02, send_period=1 + delay % 2) for delay in (0, 3, 5)]


def both(steps=40, **settings):
    """Estimates of an episode with the same action throughout."""
    env = loop_env(PLANT, **settings)

    def estimates(**options):
        infos = [env.reset(seed=1, options=options)[1]] + [env.step([0.3])[4] for _ in range(steps)]
        return np.array([info["estimate"] for info in infos])

    return estimates


def test_channel_of_an_episode_is_as_if_the_environment_were_made_with_it():
    made, other = Channel(quantization_step=0.05), Channel(loss=0.4, quantization_step=0.05, delay=3, jitter=1)
    of_made, of_other = both(channel=made), both(channel=other)
    np.testing.assert_array_equal(of_made(channel=other), of_other())
    np.testing.assert_array_equal(of_made(), of_other(channel=made))  # the next episode has the environment's own again
    assert not np.array_equal(of_made(), of_other())


def test_downlink_of_an_episode_is_as_if_the_environment_were_made_with_it():
    late, contract = Channel(loss=0.5, delay=1, max_consecutive_losses=2), ChannelContract(3)
    of_made = both(downlink=Channel(delay=3))
    np.testing.assert_array_equal(of_made(downlink=late), both(downlink=late, downlink_contract=contract)())


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_channels_of_a_reset_equal_scalar_ones_and_last_for_one_episode(mode):
    settings = {"autoreset_mode": mode, "max_episode_steps": 31, "task": SpeedTracking()}
    env = vector_env(3, plant=PLANT, channel=Channel(quantization_step=0.02), **settings)
    compare(env, 70, {"channel": LATE})
    assert set(env.episode_channels) == {env.channel}
    env.reset(seed=0, options={"channel": LATE})
    env.reset(seed=0, options={"reset_mask": np.array([True, False, False])})
    assert env.episode_channels == (Channel(quantization_step=0.02), *LATE[1:])
    env.reset(seed=0)
    assert set(env.episode_channels) == {env.channel}


@pytest.mark.parametrize("kind", [Channel, VectorNetworked])
def test_what_is_drawn_and_does_not_fit_moves_nothing(kind):
    if kind is Channel:
        envs, wrong = vector_env(2, plant=PLANT, channel=Channel(delay=1)), Channel(quantization_step=9.0)
    else:
        envs, wrong = VectorNetworked(gym.make_vec("Pendulum-v1", num_envs=2), Channel(delay=1)), 3.0
    actions = np.zeros((2, 1), np.float32)
    envs.reset(seed=0)
    envs.step(actions)
    with pytest.raises(ValueError, match=r"rounds to 9|must be a Channel"):
        envs.reset(options={"reset_mask": np.array([True, False]), "channel": lambda rng: wrong})
    *_, info = envs.step(actions)
    assert info["measurement_age"].tolist() == [1, 1]
    assert envs.episode_channels == (Channel(delay=1),) * 2


def losses(envs, steps=9, length=3):
    """What infos say of the channels of consecutive episodes of a vector environment of ours, shape (N,) each."""
    reset = envs.reset(seed=0, options={"channel": Channel(loss=0.5), "downlink": Channel(loss=0.25, delay=1)})[1]
    assert reset["downlink_loss"].tolist() == [0.25] * envs.num_envs
    found = [reset["channel_loss"]]
    for _ in range(steps):
        *_, terminated, truncated, info = envs.step(envs.action_space.sample())
        if "final_info" in info:
            found.append(info["channel_loss"])
        elif (terminated | truncated).any() and envs.unwrapped.autoreset_mode is AutoresetMode.DISABLED:
            found.append(envs.reset(options={"reset_mask": terminated | truncated})[1]["channel_loss"])
        elif not envs.unwrapped.steps.any():
            found.append(info["channel_loss"])
    return found


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_channel_of_an_option_lasts_one_episode_in_every_mode_of_autoreset(mode):
    loop = {"channel": Channel(loss=0.3), "downlink": Channel(delay=2)}
    envs = vector_env(2, plant=PLANT, max_episode_steps=3, autoreset_mode=mode, **loop)
    first, *others = losses(envs)
    assert first.tolist() == [0.5, 0.5]
    assert len(others) > 1
    assert {loss for each in others for loss in each} == {0.3}
    drawn = VectorRandomChannel(envs, [Channel(loss=0.1), Channel(loss=0.2)])
    first, *others = losses(drawn, 40)
    assert first.tolist() == [0.5, 0.5]
    assert {loss for each in others for loss in each} == {0.1, 0.2}


def test_infos_say_which_channel_an_episode_has():
    env = RandomChannel(gym.make("ncs_gym/TruckTrailer-v0"), [Channel(loss=BURSTS, delay=1, jitter=2)])
    info = env.reset(seed=0)[1]
    assert (info["channel_loss"], info["channel_delay"]) == (pytest.approx(0.4), 3)
    assert (info["downlink_loss"], info["downlink_delay"]) == (0.0, 0)
    parts = gym.spaces.Dict({"a": gym.spaces.Box(-1.0, 1.0, (1,)), "b": gym.spaces.Box(-1.0, 1.0, (1,))})
    channels = {"a": Channel(loss=0.2), "b": Channel(delay=2)}
    several = Networked(Sampled(parts), channel=channels, downlink=Channel(), neutral=0)
    info = several.reset(options={"downlink": Channel(loss=0.5)})[1]
    assert info["channel_loss"] == {"a": 0.2, "b": 0.0}
    assert info["channel_delay"] == {"a": 0, "b": 2}
    assert info["downlink_loss"] == 0.5
    many = VectorNetworked(gym.make_vec("CartPole-v1", num_envs=2), Channel(loss=0.2))
    info = many.reset(options={"channel": [Channel(loss=0.4), None]})[1]
    assert info["channel_loss"].tolist() == [0.4, 0.2]


def test_downlinks_for_each_environment_equal_scalar_ones():
    downlinks = [Channel(loss=0.5, delay=1, max_consecutive_losses=2), Channel(loss=0.2, max_consecutive_losses=1)]
    env = vector_env(2, plant=PLANT, channel=Channel(delay=1), downlink=downlinks[0], max_episode_steps=31)
    assert env.downlink_protocol.input_delay == 3
    compare(env, 90, {"downlink": downlinks})


def test_other_environments_go_on_when_a_longer_delay_joins_in_the_middle_of_their_episodes():
    def estimates(delay):
        env = vector_env(2, plant=PLANT, channel=Channel(delay=1), disturbance="ball")
        env.reset(seed=0)
        found = []
        for step in range(60):
            if step == 20:
                options = {"reset_mask": np.array([True, False]), "channel": Channel(loss=0.0, delay=delay)}
                env.reset(options=options)
            found.append(env.step(np.full((2, 1), 0.2))[4])
        return [np.array([info[key][1] for info in found]) for key in ("estimate", "error_shape", "measurement_age")]

    for short, long in zip(estimates(1), estimates(7), strict=True):
        np.testing.assert_array_equal(short, long)


def test_draws_follow_from_the_seed_and_pickled_wrappers_draw_the_same():
    env = RandomChannel(gym.make("ncs_gym/TruckTrailer-v0"), LATE)
    again = pickle.loads(pickle.dumps(env))
    drawn = [[each.reset(seed=seed) and each.unwrapped.episode_channel for seed in range(20)] for each in (env, again)]
    assert drawn[0] == drawn[1]
    assert set(drawn[0]) == set(LATE)
    for option in (Channel(delay=9), {"delay": 9}):
        env.reset(options={"channel": option})
        assert env.unwrapped.episode_channel == Channel(delay=9)
        env.reset()
        assert env.unwrapped.episode_channel in LATE
    check_env(env, skip_render_check=True)
