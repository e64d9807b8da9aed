"""Training and evaluation of stable-baselines3 agents in control loops of plant, network and shield.

A `LoopConfig` says which environment, settings and shield an agent works in; `train` returns a trained `Agent` and what
happened on the way, `evaluate` plays episodes and counts violations of the true state. `SB3VecEnv` and `SafetyCallback`
also serve training code of your own. What needs stable-baselines3 or torch (the extra `train`) is imported when it is
first asked for.
"""

from typing import TYPE_CHECKING, Any

from agents.agent import Agent, AgentError, pretrained, pretrained_folder
from agents.evaluation import evaluate
from agents.hyperparams import tuned_hyperparams, tuned_steps
from agents.loop import LagrangianSettings, LoopConfig, ShieldSettings
from agents.results import Episode, Evaluation, TrainingPoint
from ncs_gym.installation import install_command

if TYPE_CHECKING:
    from agents.callbacks import DualAscentCallback, SafetyCallback
    from agents.sb3_vec_env import SB3VecEnv
    from agents.training import TrainingResult, train, untrained

__distribution__ = "ncs-gym"

__all__ = [
    "Agent",
    "AgentError",
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
    "evaluate",
    "pretrained",
    "pretrained_folder",
    "train",
    "tuned_hyperparams",
    "tuned_steps",
    "untrained",
]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    """Imports what needs the extra `train`; raises ModuleNotFoundError with what to type if it is not installed."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        from agents import training
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "stable_baselines3"):
            raise
        needed = f"agents.{name} needs stable_baselines3 and torch, and {error.name} is not installed"
        raise ModuleNotFoundError(f"{needed}: {install_command('train')}", name=error.name) from error
    return getattr(training, name)
