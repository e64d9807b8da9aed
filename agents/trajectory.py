"""One episode, step by step, for figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What happened in one episode of T steps.

    Attributes:
        states: Shape (T + 1, n).
        estimates: Shape (T + 1, n).
        inputs: Applied, shape (T, m).
        proposed: The agent's, shape (T, m); equal to `inputs` without a shield.
        intervened: Whether the shield acted, or would have, shape (T,).
        arrivals: Whether a packet arrived after each step, shape (T,).
    """

    states: np.ndarray
    estimates: np.ndarray
    inputs: np.ndarray
    proposed: np.ndarray
    intervened: np.ndarray
    arrivals: np.ndarray


def trajectory_of(infos: list[dict[str, np.ndarray]], e: int) -> Trajectory:
    """Returns the trajectory of environment `e` from the infos of its reset and of its steps, arrays per key."""
    steps = infos[1:]
    absent = np.zeros(e + 1, np.bool_)
    return Trajectory(
        states=np.array([info["state"][e] for info in infos]),
        estimates=np.array([info["estimate"][e] for info in infos]),
        inputs=np.array([info["input"][e] for info in steps]),
        proposed=np.array([info.get("input_proposed", info["input"])[e] for info in steps]),
        intervened=np.array([info.get("shield_intervened", absent)[e] for info in steps], dtype=np.bool_),
        arrivals=np.array([info["packet_arrived"][e] for info in steps], dtype=np.bool_),
    )
