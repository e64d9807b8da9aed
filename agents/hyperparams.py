"""Hyperparameters of the learning algorithms: a dictionary of JSON values by stable-baselines3's keywords.

Most are keyword arguments of the algorithm's constructor in stable-baselines3, which judges them when a model is made
(`agents.algorithms.build_model`). `"lin_0.003"` stands for a rate that falls linearly from 0.003 during the training,
and these names are no arguments of the constructor:

- `n_envs`: number of environments stepped side by side;
- `normalize`: true, or arguments of `VecNormalize` such as `{"norm_reward": false}`;
- `noise_std`: exploration noise of off-policy algorithms, in units of the limits;
- `policy_kwargs`: may have `activation_fn`, an activation function of `torch.nn` by its name, such as "nn.ReLU".

`agents/tuned/ppo.json` has those found by a search for each registered environment (docs/agents.md).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

from ncs_gym.validation import reason_of, shown

# The package of each algorithm, which has a class of the same name.
ALGORITHMS = {
    "PPO": "stable_baselines3",
    "A2C": "stable_baselines3",
    "SAC": "stable_baselines3",
    "TD3": "stable_baselines3",
    "TRPO": "sb3_contrib",
    "TQC": "sb3_contrib",
    "CrossQ": "sb3_contrib",
}
# Numbers that are counted from 1: of a wrong one the library complains only while it trains, or never.
_COUNTS = ("n_envs", "n_steps", "n_epochs", "batch_size", "buffer_size")
# Algorithms that learn from whole rollouts of `n_steps` steps in every environment.
ON_POLICY = ("PPO", "A2C", "TRPO")

# Many environments, batches of 2048 and a higher learning rate than stable-baselines3's defaults train about eight
# times as fast at no loss of return on these small tasks (`python -m benchmarks.speed ppo`).
_ROLLOUTS = {
    "n_envs": 64,
    "gamma": 0.9,
    "gae_lambda": 0.9,
    "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -0.7},
    "normalize": True,
}
_MINIBATCHES = {**_ROLLOUTS, "n_steps": 64, "batch_size": 2048, "learning_rate": "lin_0.003"}
_REPLAY = {
    "n_envs": 64,
    "gradient_steps": 16,
    "batch_size": 256,
    "buffer_size": 200_000,
    "learning_starts": 2_000,
    "learning_rate": "lin_0.003",
    "gamma": 0.9,
    "policy_kwargs": {"net_arch": [64, 64]},
    "normalize": True,
}
# What an algorithm learns with where nothing else is said; of everything else stable-baselines3 has the defaults.
DEFAULTS: dict[str, dict[str, Any]] = {
    "PPO": {**_MINIBATCHES, "n_epochs": 10, "ent_coef": 0.0},
    "TRPO": {**_MINIBATCHES, "n_critic_updates": 10},
    "A2C": {**_ROLLOUTS, "n_steps": 8, "learning_rate": "lin_0.002"},
    "SAC": _REPLAY,
    "TD3": {**_REPLAY, "noise_std": 0.2},
    "TQC": _REPLAY,
    "CrossQ": _REPLAY,
}


def with_changes(hyperparams: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Returns hyperparameters with changes, of `policy_kwargs` entry by entry."""
    changed = {**hyperparams, **changes}
    own, given = hyperparams.get("policy_kwargs"), changes.get("policy_kwargs")
    if isinstance(own, Mapping) and isinstance(given, Mapping):
        changed["policy_kwargs"] = {**own, **given}
    return changed


def complete_hyperparams(algorithm: str, given: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Returns the hyperparameters that an algorithm is trained with: those given, and the defaults.

    Raises:
        ValueError: If the algorithm is unknown, what is given is no dictionary of JSON values, or `gamma` or a count
            such as `n_envs` is out of range.
    """
    if not (isinstance(algorithm, str) and algorithm in ALGORITHMS):
        raise ValueError(f"unknown algorithm {shown(algorithm)}; known are {', '.join(ALGORITHMS)}")
    if not isinstance(given, Mapping | None):
        raise ValueError(f"hyperparameters must be a dictionary, got {type(given).__name__}")
    try:
        copied = json.loads(json.dumps(dict(given or {}), allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"hyperparameters must be JSON values, got {shown(given)} ({reason_of(error)}); what is none is written as "
            "a text, as in 'nn.ReLU' or 'lin_0.003'"
        ) from error
    hyperparams = with_changes(DEFAULTS[algorithm], copied)
    for name in _COUNTS:
        if name in hyperparams and (type(value := hyperparams[name]) is not int or value < 1):
            raise ValueError(f"{name} must be a whole number >= 1, got {shown(value)}")
    gamma = hyperparams["gamma"]
    if type(gamma) not in (int, float) or not 0.0 <= gamma <= 1.0:
        raise ValueError(f"gamma must be in [0, 1], got {shown(gamma)}")
    return hyperparams


def rollout_steps(algorithm: str, hyperparams: Mapping[str, Any]) -> int:
    """Returns how many steps of all environments together lie between two updates; trainings end with whole ones."""
    known = {**DEFAULTS[algorithm], **hyperparams}
    return known["n_envs"] * (known["n_steps"] if algorithm in ON_POLICY else 1)


def tuned_hyperparams(env_id: str, algorithm: str = "PPO") -> dict[str, Any] | None:
    """Returns the hyperparameters tuned for a registered id; None where there are none. None but PPO is tuned."""
    entry = _tuned().get(env_id) if algorithm == "PPO" else None
    return None if entry is None else {name: value for name, value in entry.items() if name != "n_timesteps"}


def tuned_steps(env_id: str, algorithm: str = "PPO") -> int | None:
    """Returns the number of training steps that belongs to the tuned hyperparameters; None where there are none."""
    return _tuned()[env_id]["n_timesteps"] if tuned_hyperparams(env_id, algorithm) is not None else None


@cache
def _tuned() -> dict[str, dict[str, Any]]:
    return json.loads(resources.files("agents").joinpath("tuned", "ppo.json").read_text("utf-8"))
