"""Policies that need no training, and trained ones from a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ncs_gym import NCSEnv, SetpointTracking, SpeedTracking

UNTRAINED = ("greedy", "zero", "random")

# Maps an observation, shape (entries,), and its info to an action, shape (m,).
Policy = Callable[[np.ndarray, dict], np.ndarray]


def policy_by_name(name: str, env_id: str, env: NCSEnv, seed: int) -> Policy:
    """Returns a policy for an environment.

    Args:
        name: "greedy", "zero", "random", or the folder of a trained agent.
        env_id: The environment's id.
        env: The environment.
        seed: Of the random policy.

    Raises:
        AgentError: If there is no agent for this environment.
    """
    size = env.plant.m
    if name == "zero":
        return lambda observation, info: np.zeros(size, np.float32)
    if name == "random":
        rng = np.random.default_rng(seed)
        return lambda observation, info: rng.uniform(-1.0, 1.0, size).astype(np.float32)
    if name == "greedy":
        return lambda observation, info: greedy_action(env, observation, info["estimate"])
    from agents.agent import Agent, AgentError  # takes torch

    agent = Agent.load(Path(name))
    if agent.env != env_id:
        raise AgentError(f"the agent in {name} was trained in {agent.env}, not in {env_id}")
    return lambda observation, info: agent.act(observation[None])[0]


def greedy_action(env: NCSEnv, observation: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """Returns the action, shape (m,), whose next step brings the task's goal closest, blind to the safe box.

    For `SpeedTracking` the speed's error, for `SetpointTracking` the output's, is removed with all the input there is,
    and with just enough where less will do. Elsewhere |C x+| becomes as small as the unlimited least squares, clipped,
    make it.

    Args:
        env: Gives plant and task.
        observation: Whose last entry is the task's.
        estimate: x_hat, shape (n,).
    """
    plant, task = env.plant, env.task
    if isinstance(task, SpeedTracking):
        effect, missing = np.zeros(plant.m), float(observation[-1])
        effect[task.input_index] = plant.dt
    elif isinstance(task, SetpointTracking):
        effect, missing = task.output @ plant.B, float(observation[-1] - task.output @ plant.A @ estimate)
    else:
        u = np.linalg.lstsq(plant.C @ plant.B, -plant.C @ plant.A @ estimate)[0]
        return np.clip(u / plant.u_max, -1.0, 1.0).astype(np.float32)
    most = float(np.abs(effect) @ plant.u_max)
    share = min(1.0, abs(missing) / most) if most > 0.0 else 0.0
    return (share * np.sign(missing * effect)).astype(np.float32)
