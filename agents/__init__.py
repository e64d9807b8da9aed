"""Training and evaluation of stable-baselines3 agents in control loops of plant, network and shield.

A `LoopConfig` says which environment, settings and shield an agent works in; `train` returns a trained `Agent` and what
happened on the way, `evaluate` plays episodes and counts violations of the true state. `SB3VecEnv` and `SafetyCallback`
also serve training code of your own. What needs stable-baselines3 or torch (the extra `train`) is imported when it is
first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ncs_gym.installation import install_command, require_own_packages

if TYPE_CHECKING:
    from agents.agent import Agent, pretrained
    from agents.agent_file import AgentError, pretrained_folder
    from agents.algorithms import AppliedActionBuffer
    from agents.callbacks import DualAscentCallback, SafetyCallback
    from agents.evaluation import evaluate
    from agents.hyperparams import tuned_hyperparams, tuned_steps
    from agents.loop import LagrangianSettings, LoopConfig, ShieldSettings
    from agents.results import Episode, Evaluation, TrainingPoint, TrainingStopped
    from agents.sb3_vec_env import SB3VecEnv
    from agents.training import TrainingResult, train, untrained

__distribution__ = "ncs-gym"

__all__ = [
    "Agent",
    "AgentError",
    "AppliedActionBuffer",
    "DualAscentCallback",
    "Episode",
    "Evaluation",
    "LagrangianSettings",
    "LoopConfig",
    "SB3VecEnv",
    "SafetyCallback",
    "ShieldSettings",
    "TrainingPoint",
    "TrainingResult",
    "TrainingStopped",
    "evaluate",
    "pretrained",
    "pretrained_folder",
    "train",
    "tuned_hyperparams",
    "tuned_steps",
    "untrained",
]

_MODULES = {
    "agent": ("Agent", "pretrained"),
    "algorithms": ("AppliedActionBuffer",),
    "callbacks": ("DualAscentCallback", "SafetyCallback"),
    "loop": ("LagrangianSettings", "LoopConfig", "ShieldSettings"),
    "evaluation": ("evaluate",),
    "hyperparams": ("tuned_hyperparams", "tuned_steps"),
    "results": ("Episode", "Evaluation", "TrainingPoint", "TrainingStopped"),
    "sb3_vec_env": ("SB3VecEnv",),
    "agent_file": ("AgentError", "pretrained_folder"),
    "training": ("TrainingResult", "train", "untrained"),
}
# Packages of the extra `train` that modules here import.
_OF_TRAINING = {"torch", "stable_baselines3"}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __dir__() -> list[str]:
    """Returns the public names, of which none needs to be imported yet."""
    return __all__


def __getattr__(name: str) -> Any:
    """Imports the module of a public name when the name is first asked for.

    Raises:
        ModuleNotFoundError: If a package of the extra `train` is missing; it says what to type.
    """
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require_own_packages("shields")
    try:
        module = import_module(f"{__name__}.{_MODULE_OF[name]}")
    except ModuleNotFoundError as error:
        if error.name not in _OF_TRAINING:
            raise
        needed = f"agents.{name} needs stable_baselines3 and torch, and {error.name} is not installed"
        raise ModuleNotFoundError(f"{needed}: {install_command('train')}", name=error.name) from error
    return getattr(module, name)
