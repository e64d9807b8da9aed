"""Makes the models of stable-baselines3 and sb3-contrib from hyperparameters, which their constructors judge."""

from __future__ import annotations

import copy
import importlib
import importlib.util
import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import flatdim
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch.nn.modules import activation

from agents.hyperparams import ALGORITHMS, ON_POLICY, rollout_steps
from ncs_gym.installation import install_command
from ncs_gym.validation import as_number, reason_of, shown

# Arguments of the library that are no hyperparameters: they are given here.
_NO_HYPERPARAMS = ("policy", "env", "venv", "action_noise", "tensorboard_log", "verbose", "seed", "device")
_NO_HYPERPARAMS += ("_init_setup_model",)
_LINEAR = "lin_"


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """Returns the class of an algorithm; raises ModuleNotFoundError if its package is not installed."""
    package = ALGORITHMS[name]
    if importlib.util.find_spec(package) is None:
        extra = "contrib" if package == "sb3_contrib" else "train"
        distribution = package.replace("_", "-")
        raise ModuleNotFoundError(f"{name} needs {distribution}: {install_command(extra)}")
    return getattr(importlib.import_module(package), name)


def normalized_env(name: str, env: VecEnv, hyperparams: Mapping[str, Any]) -> VecNormalize:
    """Returns an environment that normalizes what an agent learns from.

    Raises:
        ValueError: If the hyperparameter `normalize` is neither true nor arguments of `VecNormalize`, or leaves
            observations as they are.
    """
    normalize = hyperparams["normalize"]
    arguments = {} if normalize is True else normalize
    if not isinstance(arguments, dict) or not arguments.get("norm_obs", True):
        raise ValueError(f"{name}: normalize must be true or have arguments of VecNormalize, got {shown(normalize)}")
    _require_known(VecNormalize, arguments, f"{name}: normalize: ")
    return VecNormalize(env, **{"gamma": hyperparams["gamma"], **arguments})


def build_model(name: str, env: VecEnv, hyperparams: Mapping[str, Any], seed: int, steps: int = 0) -> BaseAlgorithm:
    """Returns an untrained model with complete hyperparameters, whose linear rates fall over so many steps.

    Raises:
        ValueError: If there is no such hyperparameter, or stable-baselines3 does not take its value.
        ModuleNotFoundError: If the algorithm's package is not installed.
    """
    cls = algorithm_class(name)
    try:
        return cls(env=env, seed=seed, device="cpu", **_arguments(name, cls, env, hyperparams, steps))
    except Exception as error:  # the library checks by many kinds of errors
        raise ValueError(f"{name}: {reason_of(error)}") from error


def _arguments(
    name: str, cls: type[BaseAlgorithm], env: VecEnv, hyperparams: Mapping[str, Any], steps: int
) -> dict[str, Any]:
    """Returns the arguments of the constructor; raises ValueError if a hyperparameter is unknown."""
    ours = {"n_envs", "normalize"} | (set() if name in ON_POLICY else {"noise_std"})
    own: dict[str, Any] = {key: copy.deepcopy(value) for key, value in hyperparams.items() if key not in ours}
    for key, value in own.items():
        if isinstance(value, str) and value.startswith(_LINEAR):
            own[key] = _falling(float(value.removeprefix(_LINEAR)), name, env, hyperparams, steps)
    _require_known(cls, own)
    if isinstance(given := own.get("policy_kwargs"), dict) and (function := given.get("activation_fn")) is not None:
        if (named := str(function).removeprefix("nn.")) not in activation.__all__:
            raise ValueError(f"policy_kwargs: torch.nn has no activation function {shown(function)}")
        given["activation_fn"] = getattr(activation, named)
    if name in ON_POLICY and "batch_size" in own:
        own["batch_size"] = min(own["batch_size"], hyperparams["n_steps"] * env.num_envs)
    if (deviation := hyperparams.get("noise_std")) is not None:
        deviation, size = as_number(deviation, "noise_std", low=0.0), flatdim(env.action_space)
        own["action_noise"] = NormalActionNoise(np.zeros(size), deviation * np.ones(size))
    return own | {"policy": "MlpPolicy"}


def _falling(rate: float, name: str, env: VecEnv, hyperparams: Mapping[str, Any], steps: int) -> LinearSchedule:
    """Returns a rate that falls linearly, to that at the start of the last rollout.

    The library evaluates the schedule at the end of each rollout, where that of the last one would be zero.
    """
    rollout = rollout_steps(name, {**hyperparams, "n_envs": env.num_envs})
    fraction = min(rollout / steps, 1.0) if steps else 0.0
    return LinearSchedule(rate * (1.0 + fraction), rate * fraction, 1.0)


def _require_known(cls: type, arguments: Mapping[str, Any], prefix: str = "") -> None:
    """Raises ValueError if a class of the library has no such argument, or it is given here."""
    for name in arguments:
        if name not in inspect.signature(cls).parameters or name in _NO_HYPERPARAMS:
            raise ValueError(f"{prefix}unknown hyperparameter {shown(name)}")
