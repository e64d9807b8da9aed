"""Zips of stable-baselines3, loaded by its own `load`: their agents act as they did, or a sentence says why not."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction
from sb3_contrib import TQC, TRPO, CrossQ, RecurrentPPO
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

from agents import Agent, AgentError, LoopConfig, SB3VecEnv
from agents.agent import load_sb3_zip
from agents.training import untrained
from ncs_gym import TraceChannel
from tests.command import assert_one_sentence, ncs, succeeded

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
ROLLOUTS, REPLAY = {"n_steps": 8, "batch_size": 16}, {"buffer_size": 100, "learning_starts": 4}
SETTINGS = {PPO: ROLLOUTS, TRPO: ROLLOUTS, A2C: {}, SAC: REPLAY, TD3: REPLAY, TQC: REPLAY, CrossQ: REPLAY}
OBSERVATIONS = np.random.default_rng(0).standard_normal((20, 3)).astype(np.float32) * [1.0, 1.0, 20.0]


def env(count=2):
    return SB3VecEnv(LoopConfig(env=CRUISE).vector(count))


def saved(folder, cls=PPO, inner=None, policy="MlpPolicy", **settings):
    """A model after a few steps and its zip."""
    policy_kwargs = {"net_arch": [8], "activation_fn": nn.ELU}
    settings = {"policy_kwargs": policy_kwargs} | SETTINGS.get(cls, {}) | settings
    model = cls(policy, inner or env(), seed=0, device="cpu", **settings).learn(16)
    model.save(folder / "own.zip")
    return model


def saved_with_statistics(folder, cls=PPO, **settings):
    normalized = VecNormalize(env(), clip_obs=3.0, **settings)
    model = saved(folder, cls, normalized)
    normalized.save(str(folder / "vecnormalize.pkl"))
    return model, normalized


def assert_acts_as(agent, model, observations):
    np.testing.assert_array_equal(agent.act(OBSERVATIONS), model.predict(observations, deterministic=True)[0])


@pytest.mark.cases(3)
@pytest.mark.parametrize("cls", [PPO, SAC, A2C, TRPO, TD3, TQC, CrossQ])
def test_agent_acts_as_the_model_did_by_its_statistics_or_without_any(cls, tmp_path):
    model, normalized = saved_with_statistics(tmp_path, cls)
    file = tmp_path / "own.zip"
    agent = load_sb3_zip(file, CRUISE, cls.__name__, tmp_path / "vecnormalize.pkl")
    assert_acts_as(agent, model, normalized.normalize_obs(OBSERVATIONS))
    assert not np.array_equal(agent.act(OBSERVATIONS), model.predict(OBSERVATIONS, deterministic=True)[0])
    assert_acts_as(load_sb3_zip(file, CRUISE, cls.__name__, None), model, OBSERVATIONS)


def test_statistics_of_rewards_alone_leave_observations_as_they_are(tmp_path):
    model, _ = saved_with_statistics(tmp_path, norm_obs=False)
    agent = load_sb3_zip(tmp_path / "own.zip", CRUISE, "PPO", tmp_path / "vecnormalize.pkl")
    assert_acts_as(agent, model, OBSERVATIONS)


class OwnPolicy(ActorCriticPolicy):
    pass


def rescaled():
    return DummyVecEnv([lambda: RescaleAction(gym.make(CRUISE), min_action=-2.0, max_action=2.0)])


REFUSED = {
    "has a RecurrentActorCriticPolicy, not the MlpPolicy of PPO": lambda folder: saved(
        folder, RecurrentPPO, policy="MlpLstmPolicy", n_steps=8, batch_size=16
    ),
    "has a OwnPolicy": lambda folder: saved(folder, policy=OwnPolicy),
    "Observation spaces do not match": lambda folder: saved(folder, inner=VecFrameStack(env(), 4)),
    "Action spaces do not match": lambda folder: saved(folder, inner=rescaled()),
    "does not load as an agent by PPO": lambda folder: saved(folder, SAC),
    "wasn't a zip-file": lambda folder: (folder / "own.zip").write_bytes(b"PK"),
    "No such file": lambda folder: None,
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_does_not_load_or_acts_by_more_than_observations_is_one_sentence(words, tmp_path):
    REFUSED[words](tmp_path)
    with pytest.raises(AgentError, match=words) as caught:
        load_sb3_zip(tmp_path / "own.zip", CRUISE, "PPO", None)
    assert "\n" not in str(caught.value)


def test_statistics_that_are_none_are_one_sentence(tmp_path):
    saved(tmp_path)
    for content in (b"", b"{}", pickle.dumps([1, 2])):
        (tmp_path / "v.pkl").write_bytes(content)
        with pytest.raises(AgentError, match="does not load as an agent by PPO") as caught:
            load_sb3_zip(tmp_path / "own.zip", CRUISE, "PPO", tmp_path / "v.pkl")
        assert "\n" not in str(caught.value)


def test_agent_of_a_zip_is_saved_as_the_zip_that_it_was(tmp_path):
    saved(tmp_path)
    with pytest.raises(ValueError, match=r"from a zip of stable-baselines3, which is its file: save agent\.model"):
        load_sb3_zip(tmp_path / "own.zip", CRUISE, "PPO", None).save(tmp_path / "agent")
    assert not (tmp_path / "agent").exists()


def test_agent_of_a_recorded_channel_is_saved_and_loaded(tmp_path):
    """The channel's file has what the channel has: `save` writes nothing that `load` refuses."""
    agent = untrained(LoopConfig(env=CRUISE, kwargs={"channel": TraceChannel(trace=(0, 1, -1))}), seed=0)
    agent.save(tmp_path)
    assert Agent.load(tmp_path).channel == agent.channel == TraceChannel(trace=(0, 1, -1))


def test_command_loads_a_zip_only_where_it_is_trusted(tmp_path):
    saved_with_statistics(tmp_path)
    given = ("evaluate", tmp_path / "own.zip", "--env", CRUISE, "--episodes", 2, "--algorithm", "PPO")
    statistics = ("--vec-normalize", tmp_path / "vecnormalize.pkl")
    for missing in ((*given, *statistics), (*given, "--trust")):
        assert_one_sentence(ncs(*missing), "needs --env, --algorithm, --vec-normalize", "and --trust", "may run code")
    run = succeeded(*given, *statistics, "--trust")
    assert f"with --vec-normalize {tmp_path / 'vecnormalize.pkl'}" in run.prose
    assert "shield: none" in run.stdout
    assert "the channel of the id are used; give --shield" in run.stderr


@pytest.mark.parametrize("given", [("--trust",), ("--vec-normalize", "none"), ("--algorithm", "PPO")])
def test_what_is_for_zips_is_refused_for_folders(given):
    run = ncs("evaluate", "pretrained", "--env", CRUISE, *given)
    assert_one_sentence(run, "--algorithm, --vec-normalize and --trust are for zips of stable-baselines3")
