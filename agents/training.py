"""Trains a stable-baselines3 agent in a control loop, and counts what happens on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.vec_env import VecNormalize

from agents.agent import Agent, Normalization
from agents.algorithms import ALGORITHMS, algorithm_class, build
from agents.callbacks import SafetyCallback, TrainingPoint
from agents.control_loop import ControlLoop
from agents.sb3_vec_env import SB3VecEnv
from agents.settings import AgentSettings, OffPolicySettings


@dataclass(frozen=True)
class TrainingResult:
    """What a training run leaves.

    Attributes:
        agent: The trained policy.
        history: Totals along the way.
        steps: Environment steps taken (whole rollouts: at least what was asked for).
        violation_steps: Steps whose true state violated the safe box, all of training.
        interventions: Steps in which the shield intervened, all of training.
    """

    agent: Agent
    history: list[TrainingPoint]
    steps: int
    violation_steps: int
    interventions: int


def train(
    loop: ControlLoop,
    steps: int,
    seed: int,
    algorithm: str = "PPO",
    settings: AgentSettings | None = None,
    *,
    log_folder: Path | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> TrainingResult:
    """Returns a trained agent and what happened on the way; the same seed gives the same result on one machine.

    Args:
        loop: What it is trained in.
        steps: Environment steps to train for, rounded up to whole rollouts.
        seed: Seeds environments, network and sampling; loops with the same seed meet the same draws
            of nature as long as their episodes last equally long.
        algorithm: A name in `agents.algorithms`.
        settings: Of the algorithm; its defaults if None.
        log_folder: Where TensorBoard's events go.
        on_progress: Called with the number of steps taken since its last call.

    Raises:
        ValueError: If the algorithm is unknown, the settings are another's, or the steps are too few to learn.
        ModuleNotFoundError: If the algorithm's package is not installed.
    """
    algorithm_class(algorithm)
    settings = settings or ALGORITHMS[algorithm][1]()
    if isinstance(settings, OffPolicySettings) and steps <= settings.learning_starts:
        raise ValueError(f"{steps} steps train nothing: learning starts after {settings.learning_starts}")
    env = VecNormalize(SB3VecEnv(loop.vector(settings.envs)), gamma=settings.discount)
    model = build(algorithm, env, settings, seed, steps)
    model.set_logger(configure(str(log_folder), ["tensorboard"]) if log_folder else Logger(None, []))
    callback = SafetyCallback(on_progress)
    model.learn(steps, callback=callback)
    agent = _agent(loop, algorithm, settings, model, env)
    return TrainingResult(
        agent, callback.history, model.num_timesteps, callback.violation_steps, callback.interventions
    )


def untrained(loop: ControlLoop, seed: int, algorithm: str = "PPO", settings: AgentSettings | None = None) -> Agent:
    """Returns a policy with the random weights that training starts from."""
    algorithm_class(algorithm)
    settings = settings or ALGORITHMS[algorithm][1]()
    env = VecNormalize(SB3VecEnv(loop.vector(1)), training=False)
    return _agent(loop, algorithm, settings, build(algorithm, env, settings, seed), env)


def _agent(loop: ControlLoop, algorithm: str, settings: AgentSettings, model, env: VecNormalize) -> Agent:
    return Agent(
        algorithm=algorithm,
        settings=settings,
        env=loop.env,
        channel=loop.channel,
        model=model,
        normalization=Normalization.of(env),
    )
