"""Training and evaluation of stable-baselines3 agents; needs the `train` extra."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.sb3_vec_env import SB3VecEnv

__all__ = ["SB3VecEnv"]


def __getattr__(name: str) -> Any:
    """Imports stable-baselines3 only when it is asked for."""
    if name == "SB3VecEnv":
        return import_module("agents.sb3_vec_env").SB3VecEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
