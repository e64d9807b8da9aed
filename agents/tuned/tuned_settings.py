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
    if algorithm not in _FILES:
        return None
    values = _entries(algorithm).get(env_id)
    return None if values is None else _FILES[algorithm](**values)


@cache
def _entries(algorithm: str) -> dict[str, dict[str, Any]]:
    """Returns the file of an algorithm: settings by environment id."""
    return json.loads(resources.files("agents.tuned").joinpath(f"{algorithm.lower()}.json").read_text("utf-8"))
