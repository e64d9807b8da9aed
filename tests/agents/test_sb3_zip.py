"""Zips that stable-baselines3 saved: their agents act as they did, and nothing in them is unpickled."""

import numpy as np
import pytest
from stable_baselines3 import PPO, SAC

from agents.agent import is_sb3_zip, load_sb3_zip
from agents.agent_file import AgentError
from agents.loop import LoopConfig
from agents.sb3_vec_env import SB3VecEnv

CRUISE = "ncs_gym/TruckTrailerCruise-v0"


def model(cls=PPO, **policy):
    env = SB3VecEnv(LoopConfig(env=CRUISE).vector(2))
    return cls("MlpPolicy", env, policy_kwargs=dict(net_arch=[8, 8], **policy), seed=0, device="cpu")


@pytest.mark.parametrize("cls", [PPO, SAC])
def test_agent_of_a_zip_acts_as_the_model_did(cls, tmp_path):
    saved = model(cls)
    saved.save(tmp_path / "own.zip")
    assert is_sb3_zip(tmp_path / "own.zip")
    agent = load_sb3_zip(tmp_path / "own.zip", CRUISE, "none")  # a model that was never trained does not tell
    observations = np.random.default_rng(0).standard_normal((20, 3)).astype(np.float32)
    np.testing.assert_array_equal(agent.act(observations), saved.predict(observations, deterministic=True)[0])


class Unpickled(Exception):
    pass


class Trap:
    def __reduce__(self):
        return _spring, ()


def _spring():
    raise Unpickled


def test_settings_that_are_pickled_are_refused_unread(tmp_path):
    saved = model()
    saved.policy_kwargs["trap"] = Trap()
    saved.save(tmp_path / "own.zip")
    with pytest.raises(AgentError, match="pickles are not read"):
        load_sb3_zip(tmp_path / "own.zip", CRUISE)


def test_what_fits_no_environment_or_is_no_zip_is_one_sentence(tmp_path):
    model().save(tmp_path / "own.zip")
    with pytest.raises(AgentError, match="does not fit ncs_gym/CartPole-v0"):
        load_sb3_zip(tmp_path / "own.zip", "ncs_gym/CartPole-v0")
    (tmp_path / "no.zip").write_bytes(b"PK")
    with pytest.raises(AgentError, match="is no agent that stable-baselines3 saved"):
        load_sb3_zip(tmp_path / "no.zip", CRUISE)
