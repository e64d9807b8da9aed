"""Policies of single environments by name: some that need no training, and trained agents from a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from agents.agent_file import AgentError, pretrained_folder
from ncs_gym import NCSEnv, SetpointTracking, SpeedTracking

UNTRAINED_POLICIES = ("greedy", "zero", "random")
# Stands for the agent of the environment that comes with the package.
PRETRAINED = "pretrained"
# Agents that a message names.
_MOST_LISTED = 4

# Maps an observation, shape (entries,), and its info to an action, shape (m,).
Policy = Callable[[np.ndarray, dict], np.ndarray]


def policy_by_name(name: str, env_id: str, env: NCSEnv, seed: int) -> Policy:
    """Returns a policy for an environment.

    Args:
        name: "greedy", "zero", "random", "pretrained" for the agent that comes with the package, the folder of a
            trained agent or of the run that left it, or a zip of stable-baselines3.
        env_id: Id of the environment.
        env: The environment.
        seed: Seed of the random policy.

    Raises:
        AgentError: If there is no agent for this environment.
        ValueError: If the folder of a run holds several agents.
    """
    size = env.plant.m
    if name == "zero":
        return lambda observation, info: np.zeros(size, np.float32)
    if name == "random":
        rng = np.random.default_rng(seed)
        return lambda observation, info: rng.uniform(-1.0, 1.0, size).astype(np.float32)
    if name == "greedy":
        return lambda observation, info: _greedy_action(env, observation, info["estimate"])
    from agents.agent import (
        Agent,  # imports torch
        is_sb3_zip,
        load_sb3_zip,
    )

    path = pretrained_folder(env_id) if name == PRETRAINED else Path(name)
    agent = load_sb3_zip(path, env_id) if is_sb3_zip(path) else Agent.load(agent_folder(path))
    if agent.env != env_id:
        raise AgentError(f"the agent in {name} was trained in {agent.env}, not in {env_id}")
    return lambda observation, info: agent.act(observation[None])[0]


def agent_folder(folder: Path) -> Path:
    """Returns the folder of the only agent in a run's output; any other folder is returned as it is.

    Raises:
        ValueError: If the run left several agents.
    """
    models = sorted(file.parent for file in folder.glob("models/*/agent.json"))
    if (folder / "agent.json").exists() or not models:
        return folder
    if len(models) > 1:
        names = ", ".join([*(model.name for model in models[:_MOST_LISTED]), *["..."] * (len(models) > _MOST_LISTED)])
        raise ValueError(
            f"{folder} holds {len(models)} agents: give the folder of one, in {folder / 'models'} ({names})"
        )
    return models[0]


def certificate_file(agent: Path) -> Path | None:
    """Returns the certificate beside an agent, or of the run that left it in its models; None if there is none."""
    agent = agent.resolve()
    folders = [agent, agent.parent.parent] if agent.parent.name == "models" else [agent]
    return next((file for folder in folders if (file := folder / "certificate.json").is_file()), None)


def _greedy_action(env: NCSEnv, observation: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """Returns the action, shape (m,), that comes closest to the task's goal in one step and ignores the safe box.

    For `SpeedTracking` it removes the tracking error of the speed, for `SetpointTracking` that of the output, with as
    little input as possible or with the largest input. For other tasks it is the clipped least-squares solution of
    C x+ = 0.

    Args:
        env: Environment with the plant and the task.
        observation: Observation, whose entry after the estimate belongs to the task.
        estimate: Estimate x_hat, shape (n,).
    """
    plant, task = env.plant, env.task
    if isinstance(task, SpeedTracking):
        effect, missing = np.zeros(plant.m), float(observation[plant.n])
        effect[task.input_index] = plant.dt
    elif isinstance(task, SetpointTracking):
        effect, missing = task.output @ plant.B, float(observation[plant.n] - task.output @ plant.A @ estimate)
    else:
        u = np.linalg.lstsq(plant.box_rows @ plant.B, -plant.box_rows @ plant.A @ estimate)[0]
        return np.clip(u / plant.u_max, -1.0, 1.0).astype(np.float32)
    largest = float(np.abs(effect) @ plant.u_max)
    fraction = min(1.0, abs(missing) / largest) if largest > 0.0 else 0.0
    return (fraction * np.sign(missing * effect)).astype(np.float32)
