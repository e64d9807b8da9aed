"""The vector network does what the single one does, in all modes of autoreset."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from ncs_gym import Channel, GilbertElliott, Networked, TraceChannel, VectorNetworked, VectorRandomChannel
from tests.ncs_gym.networked.environments import Counter

BURSTS = GilbertElliott(p_good_to_bad=0.2, p_bad_to_good=0.4)
PAIRS = gym.spaces.Tuple([gym.spaces.Discrete(2)])
LATE, SECOND = Channel(loss=0.4, delay=1, jitter=2), Channel(delay=2, send_period=2)
KEYS = "measurement_age", "packet_arrived", "action_age", "action_applied", "packets"


def predicted(last, age, actions):
    return last + np.float32(0.001) * np.asarray(age, np.float32)[..., None] % np.float32(0.05)


SETTINGS = {
    "nothing": {},
    "everything": {"channel": Channel(loss=BURSTS, delay=1, jitter=3, send_period=2, quantization_step=0.05)},
    "both": {"channel": Channel(delay=2), "downlink": LATE},
    "neutral": {"downlink": LATE, "idle": "neutral"},
    "zeros": {"channel": LATE, "fill": "zero", "observe": ("age", "arrived", "pending_actions")},
    "predictor": {"channel": LATE, "fill": predicted},
    "record": {"channel": TraceChannel(trace=(0, 3, -1, 1, -1, -1, 0)), "observe": ("age",)},
}


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=list(SETTINGS))
def test_one_environment_is_that_of_the_single_network(settings):
    def make():
        return gym.make("Pendulum-v1")

    one, many = Networked(make(), **settings), VectorNetworked(SyncVectorEnv([make]), **settings)
    seen, seen_by_many = one.reset(seed=3), many.reset(seed=3)
    assert np.array_equal(seen[0], seen_by_many[0][0])
    one.action_space.seed(0)
    for _ in range(80):
        action = one.action_space.sample()
        seen, seen_by_many = one.step(action), many.step(np.array([action]))
        assert np.array_equal(seen[0], seen_by_many[0][0])
        assert seen[1] == pytest.approx(seen_by_many[1][0])
        for key in KEYS:
            assert np.array_equal(seen[-1][key], seen_by_many[-1][key][0]), key
        if seen[2] or seen[3]:
            return


@pytest.mark.parametrize(
    ("mode", "resets", "channel"),
    [
        (AutoresetMode.NEXT_STEP, False, SECOND),
        (AutoresetMode.NEXT_STEP, True, SECOND),  # as SB3VecEnv does
        (AutoresetMode.SAME_STEP, False, SECOND),
        (AutoresetMode.SAME_STEP, False, Channel()),
        (AutoresetMode.DISABLED, True, SECOND),
    ],
)
def test_episodes_that_end_at_different_times_begin_anew_alone(mode, resets, channel):
    lengths = 5, 7, 11
    settings = {"channel": channel, "downlink": Channel(delay=1)}
    makes = [lambda length=length: Counter(length=length) for length in lengths]
    many = VectorNetworked(SyncVectorEnv(makes, autoreset_mode=mode), **settings)
    singles = [Networked(make(), **settings) for make in makes]
    for env in (many, *singles):
        env.reset(seed=0)
    over = [False] * 3
    for k in range(40):
        actions = np.arange(3.0)[:, None] + 10.0 * k
        if resets and any(over):
            seen, info = many.reset(options={"reset_mask": np.array(over)})
            for e in np.flatnonzero(over):
                assert seen[e] == singles[e].reset()[0]
            over = [False] * 3
        seen, rewards, terminated, _, info = many.step(actions)
        for e, env in enumerate(singles):
            if over[e] and mode is AutoresetMode.NEXT_STEP:
                wanted, own = env.reset()
                over[e] = False
            else:
                wanted, reward, over[e], _, own = env.step(actions[e])
                assert (rewards[e], terminated[e]) == (reward, over[e])
                if over[e] and mode is AutoresetMode.SAME_STEP:
                    assert info["final_obs"][e] == wanted
                    assert info["final_info"]["measurement_age"][e] == own["measurement_age"]
                    (wanted, own), over[e] = env.reset(), False
            assert seen[e] == wanted, (k, e)
            assert [info[key][e] for key in KEYS] == [own[key] for key in KEYS], (k, e)


def marked(last, age, actions):
    return np.full(np.shape(last), -1)


def written_over(last, age, actions):
    last[...] = 7.5
    return last


@pytest.mark.parametrize("fill", [marked, written_over])
def test_predictions_change_no_fresh_observation(fill):
    """Whatever numbers they are of, and also where they are written into what was given."""
    many = VectorNetworked(SyncVectorEnv([lambda: gym.make("CartPole-v1")]), Channel(loss=0.3), fill=fill)
    one, ages = Networked(gym.make("CartPole-v1"), Channel(loss=0.3), fill=fill), []
    one.reset(seed=0)
    many.reset(seed=0)
    for _ in range(8):
        seen, *_ = one.step(1)
        (seen_by_many,), *_, infos = many.step(np.array([1]))
        np.testing.assert_array_equal(seen_by_many, seen)
        ages.append(int(infos["measurement_age"][0]))
        if ages[-1] == 0:
            np.testing.assert_array_equal(seen, np.float32(one.unwrapped.state))
    assert {0, 1} <= set(ages)


def test_networks_of_a_batch_are_independent_and_have_the_rate_asked_for():
    many = VectorNetworked(SyncVectorEnv([Counter] * 64), Channel(loss=0.3))
    many.reset(seed=0)
    arrived = np.array([many.step(np.zeros((64, 1)))[-1]["packet_arrived"] for _ in range(200)])
    assert arrived.mean() == pytest.approx(0.7, abs=0.02)
    assert abs(np.corrcoef(arrived.T)[np.triu_indices(64, 1)].mean()) < 0.01


def test_channels_of_episodes_are_drawn_also_where_they_begin_by_themselves():
    inner = VectorNetworked(SyncVectorEnv([lambda: Counter(length=4)] * 3), Channel())
    env = VectorRandomChannel(inner, [Channel(delay=k) for k in range(4)])
    env.reset(seed=0)
    ages = np.array([env.step(np.zeros((3, 1)))[-1]["measurement_age"] for _ in range(200)])
    assert set(ages[3::5].ravel()) == {0, 1, 2, 3}  # of last steps: the delays drawn


def test_what_vector_environments_cannot_have_is_one_sentence():
    with pytest.raises(ValueError, match=r"takes vector environments, as gym.make_vec returns, got <"):
        VectorNetworked(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="an NCSVectorEnv has one"):
        VectorNetworked(gym.make_vec("ncs_gym/TruckTrailer-v0", num_envs=2))
    with pytest.raises(ValueError, match="observations that are one array, not Dict"):
        VectorNetworked(SyncVectorEnv([lambda: gym.make("FrozenLake-v1")]), observe="age")
    with pytest.raises(ValueError, match="actions that are one array, not Tuple"):
        VectorNetworked(SyncVectorEnv([type("Pairs", (Counter,), {"action_space": PAIRS})]))
    with pytest.raises(ValueError, match=r"the first of the seeds seeds the networks, .* got \[None, 2\]"):
        VectorNetworked(SyncVectorEnv([Counter] * 2)).reset(seed=[None, 2])
