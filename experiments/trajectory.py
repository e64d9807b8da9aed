"""One episode, step by step, for figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.evaluation import Policy
from agents.training import Shielding, make_env


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What happened in one episode of T steps.

    Attributes:
        states: Shape (T + 1, n).
        estimates: Shape (T + 1, n).
        inputs: Applied, shape (T, m).
        proposed: The agent's, shape (T, m); equal to `inputs` without a shield.
        arrivals: Whether a packet arrived after each step, shape (T,).
    """

    states: np.ndarray
    estimates: np.ndarray
    inputs: np.ndarray
    proposed: np.ndarray
    arrivals: np.ndarray


def record(env_id: str, policy: Policy, seed: int, shielding: Shielding | None) -> Trajectory:
    """Returns one episode played with a policy, reset with `seed`."""
    env = make_env(env_id, shielding)
    observation, info = env.reset(seed=seed)
    infos, done = [info], False
    while not done:
        action = policy(observation[None], [infos[-1]])[0]
        observation, _, terminated, truncated, info = env.step(action)
        infos.append(info)
        done = terminated or truncated
    steps = infos[1:]
    return Trajectory(
        states=np.array([info["state"] for info in infos]),
        estimates=np.array([info["estimate"] for info in infos]),
        inputs=np.array([info["input"] for info in steps]),
        proposed=np.array([info.get("input_proposed", info["input"]) for info in steps]),
        arrivals=np.array([info["packet_arrived"] for info in steps]),
    )
