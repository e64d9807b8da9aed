"""The learning algorithms by name."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from agents.settings import A2CSettings, AgentSettings, OffPolicySettings, PPOSettings

# Where each algorithm comes from and which settings it takes.
ALGORITHMS: dict[str, tuple[str, type[AgentSettings]]] = {
    "PPO": ("stable_baselines3", PPOSettings),
    "A2C": ("stable_baselines3", A2CSettings),
    "SAC": ("stable_baselines3", OffPolicySettings),
    "TD3": ("stable_baselines3", OffPolicySettings),
    "TRPO": ("sb3_contrib", PPOSettings),
    "TQC": ("sb3_contrib", OffPolicySettings),
    "CrossQ": ("sb3_contrib", OffPolicySettings),
}


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """Returns the class of an algorithm.

    Raises:
        ValueError: If the name is unknown.
        ModuleNotFoundError: If its package is not installed.
    """
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}; known are {', '.join(ALGORITHMS)}")
    package = ALGORITHMS[name][0]
    if importlib.util.find_spec(package) is None:
        distribution = package.replace("_", "-")
        raise ModuleNotFoundError(f"{name} needs {distribution}: pip install {distribution}")
    return getattr(importlib.import_module(package), name)


def build(name: str, env: VecEnv, settings: AgentSettings, seed: int, steps: int = 0) -> BaseAlgorithm:
    """Returns an untrained agent.

    Args:
        name: In `ALGORITHMS`.
        env: What it will be trained in.
        settings: Of the algorithm.
        seed: Of network and sampling.
        steps: It will be trained for; stretches the fall of the learning rate.

    Raises:
        ValueError: If the name is unknown, or the settings are another algorithm's.
        ModuleNotFoundError: If the algorithm's package is not installed.
    """
    cls = algorithm_class(name)
    if not isinstance(settings, ALGORITHMS[name][1]):
        raise ValueError(f"{name} takes {ALGORITHMS[name][1].__name__}, got {type(settings).__name__}")
    torch.set_num_threads(1)  # more threads only pay off at batches of 16384 and make results depend on their number
    # The rate of an update is that of the start of its rollout: the library looks at the end, where the last is zero.
    rollout = env.num_envs * (1 if isinstance(settings, OffPolicySettings) else settings.rollout)
    share = min(rollout / steps, 1.0) if steps else 0.0
    rate = settings.learning_rate
    common: dict[str, Any] = {
        "learning_rate": LinearSchedule(rate * (1.0 + share), rate * share, 1.0),
        "gamma": settings.discount,
        "seed": seed,
        "device": "cpu",
        "policy_kwargs": {"net_arch": [settings.width] * 2},
    }
    if isinstance(settings, OffPolicySettings):
        return cls("MlpPolicy", env, **common, **_replay(name, settings, env.action_space.shape[0]))
    common["policy_kwargs"]["log_std_init"] = settings.log_std
    common |= {"n_steps": settings.rollout, "gae_lambda": settings.gae_lambda}
    if isinstance(settings, PPOSettings):
        common["batch_size"] = min(settings.batch_size, settings.rollout * env.num_envs)
        common["n_epochs" if name == "PPO" else "n_critic_updates"] = settings.epochs
    return cls("MlpPolicy", env, **common)


def _replay(name: str, settings: OffPolicySettings, inputs: int) -> dict[str, Any]:
    """Returns what algorithms with a replay buffer take besides."""
    noise = NormalActionNoise(np.zeros(inputs), settings.noise * np.ones(inputs)) if name == "TD3" else None
    return {
        "batch_size": settings.batch_size,
        "buffer_size": settings.buffer_size,
        "learning_starts": settings.learning_starts,
        "train_freq": 1,
        "gradient_steps": settings.gradient_steps,
        "action_noise": noise,
    }
