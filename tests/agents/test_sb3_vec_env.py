import json
import runpy
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from agents import LoopConfig, SB3VecEnv, untrained
from ncs_gym import VectorRequestActions
from shields import VectorSafetyShield
from tests.product import vector_shield

CRUISE = "ncs_gym/TruckTrailerCruise-v0"


class Laps(gym.Env):
    """Reports a lap in the step that ends one, nested numbers, and how far it was at an episode's end."""

    observation_space = action_space = gym.spaces.Box(-np.inf, np.inf, (1,))

    def __init__(self, lap):
        self.lap = lap

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.start = 0, self.np_random.random()
        return np.array([self.start], np.float32), {"start": self.start}

    def step(self, action):
        self.steps += 1
        info: dict = {"final_distance": float(self.lap), "terms": {"speed": float(self.steps)}}
        info |= {"lap_time": float(self.lap)} if self.steps % self.lap == 0 else {}
        ends = self.steps == 7 + self.lap
        info |= {"end": float(self.steps)} if ends else {}
        observation = np.array([self.start + action.item()], np.float32)
        return observation, float(self.steps), ends and self.lap == 2, ends and self.lap == 3, info


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_gymnasiums_sync_environment_is_stepped_exactly_like_stable_baselines3s_own(mode):
    makes = [lambda: Laps(2), lambda: Laps(3)]
    names = ("final_distance", "terms", "lap_time", "end")
    ours = SB3VecEnv(gym.vector.SyncVectorEnv(makes, autoreset_mode=mode), info_keywords=names)
    theirs = DummyVecEnv([lambda make=make: Monitor(make()) for make in makes])
    for env in (ours, theirs):
        env.seed(5)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    ends = 0
    for step in range(40):
        one, other = (env.step(np.full((2, 1), step)) for env in (ours, theirs))
        for mine, expected in zip(one[:3], other[:3], strict=True):
            np.testing.assert_array_equal(mine, expected, err_msg=f"step {step}")
        for mine, expected in zip(one[3], other[3], strict=True):
            episode, own = mine.pop("episode", {}), expected.pop("episode", {})
            assert (episode.get("l"), episode.get("r")) == (own.get("l"), own.get("r"))
            assert mine == expected
            ends += bool(own)
        assert ours.reset_infos == theirs.reset_infos
    assert ends > 6


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_our_vector_environment_loses_no_transition(mode):
    vector = gym.make_vec("ncs_gym/CartPole-v0", num_envs=20, max_episode_steps=40, autoreset_mode=mode)
    env = SB3VecEnv(vector, info_keywords=("cost", "estimate"))
    env.seed(0)
    observation = env.reset()
    rng, ends, cuts, steps = np.random.default_rng(1), 0, 0, np.zeros(20, int)
    for _ in range(120):
        fresh, reward, done, infos = env.step(rng.uniform(-0.3, 0.3, (20, 1)).astype(np.float32))
        steps += 1
        inner = vector.unwrapped
        assert reward.dtype == np.float32
        assert (inner.steps[done] == 0).all()
        for e, info in enumerate(infos):
            assert ("terminal_observation" in info) == done[e]
            if done[e]:
                ends += 1
                cut = info["TimeLimit.truncated"]
                cuts += cut
                assert cut == (steps[e] == 40 and info["cost"] == 0.0)
                assert info["episode"]["l"] == steps[e]
                assert info["episode"]["is_success"] == float(info["episode_violations"] == 0.0)
                np.testing.assert_allclose(info["terminal_observation"][:4], info["estimate"], rtol=1e-6)
                assert not np.array_equal(fresh[e], info["terminal_observation"])
                steps[e] = 0
        np.testing.assert_array_equal(env.batch_info["cost"] > 0, [info.get("cost", 0) > 0 for info in infos])
        observation = fresh
    assert observation in vector.observation_space
    assert 0 < cuts < ends


def test_options_reach_the_environment_once():
    env = SB3VecEnv(gym.make_vec(CRUISE, num_envs=2))
    env.set_options({"state": np.array([0.5, 0.0])})
    env.reset()
    assert env.reset_infos[1]["state"][0] == 0.5
    env.reset()
    assert env.reset_infos[1]["state"][0] != 0.5
    for options in ([{"state": np.zeros(2)}, {"state": np.full(2, 1e-12)}], [{"state": np.zeros(2)}, {}]):
        env.set_options(options)
        with pytest.raises(ValueError, match="the same options"):
            env.reset()
        assert env.reset().shape == (2, 3)  # they are refused once


def test_infos_of_a_step_are_plain_dictionaries_of_what_callbacks_read():
    env = SB3VecEnv(vector_shield(gym.make_vec(CRUISE, num_envs=3)))
    env.reset()
    infos = env.step(np.ones((3, 1), np.float32))[3]
    shields = {"shield_intervened", "shield_correction", "shield_guaranteed"}
    assert all(type(info) is dict and info.keys() == {"TimeLimit.truncated", "cost", *shields} for info in infos)
    assert [info["shield_correction"] for info in infos] == env.batch_info["shield_correction"].tolist()
    assert json.loads(json.dumps(infos)) == infos
    with pytest.raises(ValueError, match="info_keywords must be names of infos, such as"):
        SB3VecEnv(env.vector_env, info_keywords="cost")


def test_attributes():
    shield = vector_shield(gym.make_vec(CRUISE, num_envs=3), mode="switch")
    env = SB3VecEnv(RecordEpisodeStatistics(shield))
    assert env.get_attr("render_mode") == [None] * 3
    assert env.get_attr("plant", [0, 2]) == [shield.unwrapped.plant] * 2
    assert env.get_attr("mode") == ["switch"] * 3
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.get_images() == [None] * 3
    assert env.env_is_wrapped(VectorSafetyShield, 1) == [True]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [False] * 3
    for call in (
        *(partial(env.get_attr, name) for name in ("nothing", "steps", "known", "start", "episode_channel")),
        lambda: env.set_attr("plant", 1),
        lambda: env.env_method("reset"),
    ):
        with pytest.raises(AttributeError):
            call()
    with pytest.raises(AttributeError, match=r"reaches no request of single environments: use vec_env\.vector_env$"):
        env.env_method("request")
    asking = SB3VecEnv(VectorRequestActions(gym.make_vec("ncs_gym/ConvoyOnRequest-v0", num_envs=2)))
    assert asking.get_attr("action_space") == [asking.action_space] * 2
    assert asking.action_space.shape == (2,)
    with pytest.raises(ValueError, match="cannot reset some environments in the step that ends"):
        SB3VecEnv(gym.make_vec("CartPole-v1", num_envs=2))
    with pytest.raises(ValueError, match="must be a gymnasium VectorEnv"):
        SB3VecEnv(gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="VecNormalize around SB3VecEnv"):
        SB3VecEnv(NormalizeObservation(gym.make_vec(CRUISE, num_envs=2)))


def test_actions_are_those_that_were_handed_over_whatever_is_written_into_them_later():
    env = SB3VecEnv(gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=2), info_keywords=("input",))
    env.reset()
    actions = np.full((2, 1), 0.25, np.float32)
    env.step_async(actions)
    actions[:] = 1.0
    _, _, _, infos = env.step_wait()
    assert [info["input"] for info in infos] == [1.0, 1.0]  # a quarter of u_max = 4


def test_importing_sets_torch_to_one_thread_and_a_later_choice_stays():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        runpy.run_module("agents.sb3_vec_env")
        assert torch.get_num_threads() == 1
        torch.set_num_threads(2)
        untrained(LoopConfig(env=CRUISE), 0)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
