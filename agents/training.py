"""Trains a stable-baselines3 agent in a control loop, and counts violations and interventions on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.vec_env import VecNormalize

from agents.agent import Agent, Normalization
from agents.algorithms import build_model, checked_settings
from agents.callbacks import DualAscentCallback, EvaluationCallback, SafetyCallback
from agents.loop import CostPenalty, LoopConfig
from agents.results import TrainingPoint
from agents.sb3_vec_env import SB3VecEnv
from agents.settings import AgentSettings, OffPolicySettings


@dataclass(frozen=True)
class TrainingResult:
    """What a training run returns.

    Attributes:
        agent: The trained policy.
        history: Totals up to different steps of the training.
        steps: Environment steps taken, in whole rollouts: at least as many as were asked for.
        violation_steps: Training steps whose true state violated the safe box.
        interventions: Training steps in which the shield intervened.
    """

    agent: Agent
    history: list[TrainingPoint]
    steps: int
    violation_steps: int
    interventions: int


def train(
    loop: LoopConfig,
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
        loop: The control loop the agent is trained in.
        steps: Environment steps to train for, rounded up to whole rollouts.
        seed: Seed of environments, network weights and sampling. Loops with the same seed use common random numbers
            (starts, disturbances, noise, packet losses) as long as their episodes last equally long.
        algorithm: A name in `agents.algorithms.ALGORITHMS`.
        settings: Settings of the algorithm; None for its defaults.
        log_folder: Folder for TensorBoard's events, with evaluations on the way; None for neither.
        on_progress: Called with the number of steps taken since its last call.

    Raises:
        ValueError: If the algorithm is unknown, the settings are those of another one, or no step is left to learn in.
        ModuleNotFoundError: If the algorithm's package is not installed.
    """
    settings = checked_settings(algorithm, settings)
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    if isinstance(settings, OffPolicySettings) and steps <= settings.learning_starts:
        raise ValueError(f"{steps} steps train nothing: learning starts after {settings.learning_starts}")
    envs = loop.vector(settings.envs)
    normalized = getattr(settings, "normalize_rewards", True)
    env = VecNormalize(SB3VecEnv(envs), gamma=settings.discount, norm_reward=normalized)
    model = build_model(algorithm, env, settings, seed, steps)
    model.set_logger(configure(str(log_folder), ["tensorboard"]) if log_folder else Logger(None, []))
    callback = SafetyCallback(on_progress)
    beside: list[BaseCallback] = [callback]
    if loop.lagrangian is not None and isinstance(envs, CostPenalty):
        beside.append(DualAscentCallback(loop.lagrangian, envs))
    if log_folder:
        beside.append(EvaluationCallback(loop, seed))
    model.learn(steps, callback=beside)
    agent = _agent(loop, algorithm, settings, model, env)
    return TrainingResult(
        agent, callback.history, model.num_timesteps, callback.violation_steps, callback.interventions
    )


def untrained(loop: LoopConfig, seed: int, algorithm: str = "PPO", settings: AgentSettings | None = None) -> Agent:
    """Returns an agent with the random weights that training starts from; arguments and errors as for `train`."""
    settings = checked_settings(algorithm, settings)
    env = VecNormalize(SB3VecEnv(loop.vector(1)), training=False)
    return _agent(loop, algorithm, settings, build_model(algorithm, env, settings, seed), env)


def _agent(loop: LoopConfig, algorithm: str, settings: AgentSettings, model: BaseAlgorithm, env: VecNormalize) -> Agent:
    return Agent(
        algorithm=algorithm,
        settings=settings,
        env=loop.env,
        channel=loop.channel,
        model=model,
        normalization=Normalization.of(env),
        residual_gain=loop.residual_gain,
        shield_mode=loop.shield and loop.shield.mode,
        horizon=loop.shield and loop.shield.horizon,
    )
