"""Reads the tuned settings of an environment."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any

from agents.settings import AgentSettings, PPOSettings

# The class of the settings in each file of this folder; none is tuned for the other algorithms.
_FILES: dict[str, type[AgentSettings]] = {"PPO": PPOSettings}


def tuned_settings(env_id: str, algorithm: str = "PPO") -> AgentSettings | None:
    """Returns the settings tuned for an environment; None where there are none, as for plants of one's own.

    Args:
        env_id: Id by which the environment is registered.
        algorithm: Name of the learning algorithm.
    """
    entry = _entry(env_id, algorithm)
    if entry is None:
        return None
    return _FILES[algorithm](**{name: value for name, value in entry.items() if name != "steps"})


def tuned_steps(env_id: str, algorithm: str = "PPO") -> int | None:
    """Returns the number of training steps that belongs to the tuned settings of an environment; None without any."""
    entry = _entry(env_id, algorithm)
    return None if entry is None else entry["steps"]


def _entry(env_id: str, algorithm: str) -> dict[str, Any] | None:
    """Returns the entry of an environment in the file of an algorithm."""
    return _entries(algorithm).get(env_id) if algorithm in _FILES else None


@cache
def _entries(algorithm: str) -> dict[str, dict[str, Any]]:
    """Returns the file of an algorithm: settings by environment id."""
    return json.loads(resources.files("agents.tuned").joinpath(f"{algorithm.lower()}.json").read_text("utf-8"))
