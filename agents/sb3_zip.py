"""Reads an agent that stable-baselines3 saved, without unpickling anything: weights, and what stands there in JSON."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.save_util import load_from_zip_file

from agents.agent import Agent, Normalization
from agents.algorithms import algorithm_class
from agents.loop import LoopConfig
from agents.sb3_vec_env import SB3VecEnv
from agents.sharing.agent_file import AGENT_FILES, AgentError

# What only one algorithm's file has among its settings; the first that fits.
_MARKS = {"TQC": "top_quantiles_to_drop_per_net", "SAC": "target_entropy", "TD3": "target_policy_noise"}
_MARKS |= {"PPO": "clip_range", "TRPO": "cg_max_steps", "A2C": "gae_lambda"}


def is_sb3_zip(path: Path) -> bool:
    """Returns whether a path is a zip of stable-baselines3, and not a file of an `Agent`."""
    return path.suffix == ".zip" and not (path.name in AGENT_FILES and path.with_name("agent.json").exists())


def load_sb3_zip(path: Path, env_id: str) -> Agent:
    """Returns an agent that was saved by `model.save`, of an environment whose observations it saw as they are.

    Args:
        path: The zip.
        env_id: Id of the environment.

    Raises:
        AgentError: If it cannot be read, is of an unknown algorithm, has settings that only unpickling would tell, or
            does not fit the environment.
        ModuleNotFoundError: If the algorithm's package is not installed.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
        _, parameters, _ = load_from_zip_file(path, load_data=False, device="cpu")
        algorithm = next((name for name, mark in _MARKS.items() if mark in data), None)
        policy = data.get("policy_kwargs", {})
    except Exception as error:  # a forged file may break any part of the libraries that read it
        raise AgentError(
            f"{path} is no agent that stable-baselines3 saved: {str(error) or type(error).__name__}"
        ) from error
    if algorithm is None:
        raise AgentError(f"{path} is of none of the algorithms {', '.join(_MARKS)}")
    if ":serialized:" in policy:
        raise AgentError(
            f"the policy_kwargs in {path} are pickled, and pickles are not read: load it yourself, and evaluate it "
            "with agents.evaluate"
        )
    cls = algorithm_class(algorithm)
    replay: dict[str, Any] = {"buffer_size": 1} if algorithm in ("TQC", "SAC", "TD3") else {}
    try:
        model = cls(
            "MlpPolicy", SB3VecEnv(LoopConfig(env=env_id).vector(2)), policy_kwargs=policy, device="cpu", **replay
        )
        model.set_parameters(parameters, exact_match=True, device="cpu")
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise AgentError(f"the agent in {path} does not fit {env_id}: {reason}") from error
    size = int(np.prod(model.observation_space.shape or ()))
    return Agent(
        algorithm=algorithm,
        hyperparams={"policy_kwargs": policy},
        env=env_id,
        channel=None,
        model=model,
        normalization=Normalization(np.zeros(size), np.ones(size), 0.0, float("inf")),
    )
