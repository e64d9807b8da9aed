"""The only place that knows former names of settings: files and programs written with them stay readable."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from agents.hyperparams import tuned_hyperparams, with_changes

# Former names of hyperparameters that only have other names now.
_RENAMED = {
    "envs": "n_envs",
    "rollout": "n_steps",
    "epochs": "n_epochs",
    "discount": "gamma",
    "entropy": "ent_coef",
    "noise": "noise_std",
}
_RENAMED_SETTINGS = {"references": "baselines", "conditions": "scenarios"}
# The groups of settings that a file had, and those of a command line with an algorithm that took them.
_GROUPS = ("ppo", "a2c", "off_policy")
FORMER_FLAGS = {"--ppo": "PPO", "--a2c": "A2C", "--off-policy": "TD3"}


def from_former(algorithm: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns former settings of an algorithm as hyperparameters; None stands for what is not given."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if value is None or (name == "entropy" and algorithm == "TRPO") or (name == "noise" and algorithm != "TD3"):
            continue  # it had no effect there
        if name == "width":
            found = with_changes(found, {"policy_kwargs": {"net_arch": [value, value]}})
        elif name == "log_std":
            found = with_changes({"policy_kwargs": {"log_std_init": value}}, found)
        elif name == "learning_rate":
            found[name] = f"lin_{value!r}"
        elif name == "normalize_rewards":
            found["normalize"] = value or {"norm_reward": False}
        else:
            found[_RENAMED.get(name, name)] = value
    if algorithm == "TRPO" and "n_epochs" in found:
        found["n_critic_updates"] = found.pop("n_epochs")
    return found


def from_former_file(settings: dict[str, Any]) -> dict[str, Any]:
    """Returns a command's settings of JSON by their present names, hyperparameters as `hyperparams`."""
    settings = {_RENAMED_SETTINGS.get(name, name): value for name, value in settings.items()}
    if not any(group in settings for group in _GROUPS):
        return settings
    algorithm = str(settings.get("algo", "PPO"))
    own = {"PPO": "ppo", "TRPO": "ppo", "A2C": "a2c"}.get(algorithm, "off_policy")
    kept = {name: value for name, value in settings.items() if name not in _GROUPS}
    group, given = settings.get(own) or {}, settings.get("hyperparams") or {}
    for name, value in ((own, group), ("hyperparams", given)):
        if not isinstance(value, dict):
            raise TypeError(f"{name} = {value!r}")
    return kept | {"hyperparams": with_changes(from_former(algorithm, group), given)}


class FormerSettings:
    """Settings of an algorithm by their former names, which training code still takes in place of hyperparameters."""

    def __init__(self, **settings: Any) -> None:
        advice = 'hyperparameters are now a dictionary in the words of stable-baselines3: {"n_envs": 64, "gamma": 0.9}'
        warnings.warn(advice, DeprecationWarning, stacklevel=2)
        self.settings = settings


class PPOSettings(FormerSettings):
    """Settings of PPO and TRPO by their former names."""


class A2CSettings(FormerSettings):
    """Settings of A2C by their former names."""


class OffPolicySettings(FormerSettings):
    """Settings of SAC, TD3, TQC and CrossQ by their former names."""


def tuned_settings(env_id: str, algorithm: str = "PPO") -> dict[str, Any] | None:
    """Returns `tuned_hyperparams`, by its former name."""
    warnings.warn("tuned_settings is now tuned_hyperparams", DeprecationWarning, stacklevel=2)
    return tuned_hyperparams(env_id, algorithm)
