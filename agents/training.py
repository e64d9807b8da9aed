"""Trains a stable-baselines3 agent in a control loop, and counts violations and interventions on the way."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gymnasium.vector import VectorEnv
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.vec_env import VecNormalize

from agents.agent import Agent, Normalization, require_kept
from agents.algorithms import build_model, normalized_env
from agents.callbacks import OTHERS, DualAscentCallback, SafetyCallback
from agents.hyperparams import ON_POLICY, complete_hyperparams
from agents.loop import CostPenalty, LoopConfig
from agents.results import TrainingPoint
from agents.sb3_vec_env import SB3VecEnv
from ncs_gym.validation import counted, reason_of, warn_caller

# Observations that the normalization of an agent to go on from counts as.
KNOWN_STEPS = 100_000


@dataclass(frozen=True)
class TrainingResult:
    """A trained agent, totals up to different steps of its training, and those at the end (see `TrainingPoint`)."""

    agent: Agent
    history: list[TrainingPoint] = field(repr=False)
    steps: int
    violation_steps: int
    interventions: int


def train(
    loop: LoopConfig,
    steps: int,
    seed: int,
    algorithm: str = "PPO",
    hyperparams: Mapping[str, Any] | None = None,
    *,
    log_folder: Path | None = None,
    on_progress: Callable[[int], None] | None = None,
    callbacks: Sequence[BaseCallback] = (),
    start: Agent | None = None,
) -> TrainingResult:
    """Returns a trained agent and what happened on the way; the same seed gives the same result on one machine.

    Args:
        loop: The control loop.
        steps: Environment steps to train for, rounded up to whole rollouts.
        seed: Seed of environments, network weights and sampling. Loops with the same seed use common random numbers
            (starts, disturbances, noise, packet losses) as long as their episodes last equally long.
        algorithm: A name in `agents.hyperparams.ALGORITHMS`.
        hyperparams: Keyword arguments of the algorithm in stable-baselines3, and `n_envs` and `normalize`, JSON values;
            what is not given has the values of `agents.hyperparams.DEFAULTS`.
        log_folder: Folder for TensorBoard's events.
        on_progress: Called with the number of steps taken since its last call; an exception ends the training.
        callbacks: Callbacks of stable-baselines3 of your own, after those of this package.
        start: An agent to go on from, of the same environment, algorithm and networks: its weights, optimizers and
            normalization. Give another seed: with the same one it meets the same starts and packet losses once more.

    Warns:
        UserWarning: If files of agents do not keep a keyword argument of the environment.

    Raises:
        ValueError: If the agent to go on from does not fit, the algorithm or a hyperparameter is unknown,
            stable-baselines3 does not take a value, or no step is left to learn in.
        ModuleNotFoundError: If the algorithm's package is not installed.
    """
    hyperparams = complete_hyperparams(algorithm, hyperparams)
    try:
        require_kept(loop.other_kwargs, loop.env)
    except ValueError as error:
        warn_caller(f"the agent cannot be saved: {error}", UserWarning)
    envs, env, model = _trainable(loop, steps, seed, algorithm, hyperparams)
    model.set_logger(configure(str(log_folder), ["tensorboard"]) if log_folder else Logger(None, []))
    beside: list[BaseCallback] = []
    priced = envs if loop.lagrangian is not None and isinstance(envs, CostPenalty) else None
    if loop.lagrangian is not None and priced is not None and (episode_steps := loop.episode_steps) is not None:
        # Before the totals, which hold the next price.
        beside.append(DualAscentCallback(loop.lagrangian, priced, episode_steps))
    callback = SafetyCallback(on_progress, priced)
    beside.append(callback)
    if start is not None:
        _go_on(start, loop, algorithm, model, env)
    model.learn(steps, callback=[*beside, *callbacks])
    agent = _agent(loop, algorithm, hyperparams, model, env, seed)
    return TrainingResult(
        agent, callback.history, model.num_timesteps, callback.violation_steps, callback.interventions
    )


def untrained(
    loop: LoopConfig, seed: int, algorithm: str = "PPO", hyperparams: Mapping[str, Any] | None = None
) -> Agent:
    """Returns an agent with the random weights that training starts from; arguments and errors as for `train`."""
    hyperparams = complete_hyperparams(algorithm, hyperparams)
    env = VecNormalize(SB3VecEnv(loop.vector(2)), training=False)  # PPO refuses rollouts of a single step
    return _agent(loop, algorithm, hyperparams, build_model(algorithm, env, hyperparams, seed), env, seed)


def require_trainable(loop: LoopConfig, steps: int, algorithm: str, hyperparams: Mapping[str, Any]) -> None:
    """Raises what `train` would with these arguments."""
    _trainable(loop, steps, 0, algorithm, complete_hyperparams(algorithm, hyperparams))[0].close()


def _trainable(
    loop: LoopConfig, steps: int, seed: int, algorithm: str, hyperparams: dict[str, Any]
) -> tuple[VectorEnv, VecNormalize, BaseAlgorithm]:
    """Returns what a training begins with: the environments, the same as stable-baselines3 sees them, and the model."""
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    if loop.lagrangian is not None and algorithm not in ON_POLICY:
        raise ValueError(
            f"lagrangian is for {', '.join(ON_POLICY)}, which learn from what they have just done: the replay buffer "
            f"of {algorithm} keeps rewards with the price of a violation that there was when they were collected"
        )
    envs = loop.vector(hyperparams["n_envs"])
    try:
        seen = SB3VecEnv(envs)
    except ValueError as error:
        raise ValueError(f"{loop.env}: {error}; {OTHERS}") from error
    env = normalized_env(algorithm, seen, hyperparams)
    model = build_model(algorithm, env, hyperparams, seed, steps)
    if algorithm not in ON_POLICY and steps <= hyperparams["learning_starts"]:
        raise ValueError(
            f"a training of {counted(steps, 'step')} trains nothing: learning starts after "
            f"{hyperparams['learning_starts']}"
        )
    return envs, env, model


def _go_on(start: Agent, loop: LoopConfig, algorithm: str, model: BaseAlgorithm, env: VecNormalize) -> None:
    """Puts weights, optimizers and normalization of an agent into a model and its environment."""
    if (start.env, start.algorithm) != (loop.env, algorithm):
        raise ValueError(
            f"the agent to go on from is {start.algorithm} of {start.env}, this is {algorithm} of {loop.env}"
        )
    try:
        parameters: Any = deepcopy(start.model.get_parameters())  # optimizers go on using the tensors they load
        model.set_parameters(parameters, exact_match=True, device="cpu")
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"the agent to go on from has other networks: {reason_of(error)}") from error
    statistics = env.obs_rms
    if not isinstance(statistics, dict):
        statistics.mean, statistics.var = start.normalization.mean.copy(), start.normalization.variance.copy()
        statistics.count = float(KNOWN_STEPS)


def _agent(
    loop: LoopConfig, algorithm: str, hyperparams: dict[str, Any], model: BaseAlgorithm, env: VecNormalize, seed: int
) -> Agent:
    return Agent(
        algorithm=algorithm,
        hyperparams=hyperparams,
        env=loop.env,
        channel=loop.channel,
        model=model,
        normalization=Normalization.of(env),
        seed=seed,
        shield_mode=loop.shield and loop.shield.mode,
        horizon=loop.shield and loop.shield.horizon,
        kwargs=loop.other_kwargs,
    )
