"""The learning algorithms of stable-baselines3 and sb3-contrib, by name."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import flatdim
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from agents.settings import A2CSettings, AgentSettings, OffPolicySettings, PPOSettings

# The package of each algorithm and the class of its settings.
ALGORITHMS: dict[str, tuple[str, type[AgentSettings]]] = {
    "PPO": ("stable_baselines3", PPOSettings),
    "A2C": ("stable_baselines3", A2CSettings),
    "SAC": ("stable_baselines3", OffPolicySettings),
    "TD3": ("stable_baselines3", OffPolicySettings),
    "TRPO": ("sb3_contrib", PPOSettings),
    "TQC": ("sb3_contrib", OffPolicySettings),
    "CrossQ": ("sb3_contrib", OffPolicySettings),
}


def checked_settings(name: str, settings: AgentSettings | None) -> AgentSettings:
    """Returns the settings of an algorithm: the given ones, or its defaults for None.

    Raises:
        ValueError: If the name is unknown, or the settings are those of another algorithm.
        ModuleNotFoundError: If the algorithm's package is not installed.
    """
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}; known are {', '.join(ALGORITHMS)}")
    package, kind = ALGORITHMS[name]
    if importlib.util.find_spec(package) is None:
        extra = "contrib" if package == "sb3_contrib" else "train"
        distribution = package.replace("_", "-")
        raise ModuleNotFoundError(f"{name} needs {distribution}: in a clone of ncs-gym, pip install -e '.[{extra}]'")
    if settings is not None and not isinstance(settings, kind):
        raise ValueError(f"{name} takes {kind.__name__}, got {type(settings).__name__}")
    return settings or kind()


def build_model(name: str, env: VecEnv, settings: AgentSettings, seed: int, steps: int = 0) -> BaseAlgorithm:
    """Returns an untrained model.

    Args:
        name: A name in `ALGORITHMS`.
        env: The environment it will be trained in.
        settings: Settings of the algorithm.
        seed: Seed of the network's weights and of sampling.
        steps: Number of steps it will be trained for, over which the learning rate falls to zero.

    Raises:
        ValueError: If the name is unknown, or the settings are those of another algorithm.
        ModuleNotFoundError: If the algorithm's package is not installed.
    """
    settings = checked_settings(name, settings)
    cls = getattr(importlib.import_module(ALGORITHMS[name][0]), name)
    torch.set_num_threads(1)  # more threads only pay off at batches of 16384 and make results depend on their number
    common: dict[str, Any] = {
        "learning_rate": _learning_rate(env, settings, steps),
        "gamma": settings.discount,
        "seed": seed,
        "device": "cpu",
        "policy_kwargs": {"net_arch": [settings.width] * 2},
    }
    if isinstance(settings, OffPolicySettings):
        return cls("MlpPolicy", env, **common, **_replay(name, settings, flatdim(env.action_space)))
    common["policy_kwargs"]["log_std_init"] = settings.log_std
    common |= {"n_steps": settings.rollout, "gae_lambda": settings.gae_lambda}
    if isinstance(settings, PPOSettings):
        common["batch_size"] = min(settings.batch_size, settings.rollout * env.num_envs)
        common["n_epochs" if name == "PPO" else "n_critic_updates"] = settings.epochs
        common |= {"ent_coef": settings.entropy} if name == "PPO" else {}
    return cls("MlpPolicy", env, **common)


def _learning_rate(env: VecEnv, settings: AgentSettings, steps: int) -> LinearSchedule:
    """Returns a learning rate that falls linearly; the last update still has the rate at the start of its rollout.

    The library evaluates the schedule at the end of each rollout, where that of the last one would be zero.
    """
    rollout = env.num_envs * (1 if isinstance(settings, OffPolicySettings) else settings.rollout)
    fraction = min(rollout / steps, 1.0) if steps else 0.0
    rate = settings.learning_rate
    return LinearSchedule(rate * (1.0 + fraction), rate * fraction, 1.0)


def _replay(name: str, settings: OffPolicySettings, inputs: int) -> dict[str, Any]:
    """Returns the further arguments of algorithms with a replay buffer."""
    noise = NormalActionNoise(np.zeros(inputs), settings.noise * np.ones(inputs)) if name == "TD3" else None
    return {
        "batch_size": settings.batch_size,
        "buffer_size": settings.buffer_size,
        "learning_starts": settings.learning_starts,
        "train_freq": 1,
        "gradient_steps": settings.gradient_steps,
        "action_noise": noise,
    }
