"""What stands between an agent that is trained and its control loop: the price of a violation, and a gain."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper


class CostPenalty(VectorWrapper):
    """Subtracts a penalty from the reward of every step after which the true state violates the safe box.

    Args:
        env: A vector environment with `cost` in its infos.
        penalty: Subtracted per violating step; may be changed while an agent is trained.
    """

    def __init__(self, env: VectorEnv, penalty: float) -> None:
        super().__init__(env)
        self.penalty = penalty

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps the environments; the cost of an episode's last step is read from its final info."""
        observation, rewards, terminated, truncated, info = self.env.step(actions)
        cost, done = info["cost"], terminated | truncated
        if "final_info" in info:
            cost = np.where(done, info["final_info"]["cost"], cost)
        return observation, rewards - self.penalty * cost, terminated, truncated, info


class ResidualActions(VectorWrapper):
    """Applies u = gain x_hat plus the agent's part, clipped to the limits (residual policies, Silver et al. 2018).

    Args:
        env: A vector environment whose observations begin with the estimate.
        gain: Normalized gain, shape (m, n): the input in units of its limit for an estimate in physical units.
    """

    def __init__(self, env: VectorEnv, gain: np.ndarray) -> None:
        super().__init__(env)
        self.gain = gain

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Starts episodes."""
        self._observation, info = self.env.reset(**options)
        return self._observation, info

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps the environments with the sum of both parts."""
        self._observation, *rest = self.env.step(with_gain(self.gain, self._observation, actions))
        return (self._observation, *rest)  # type: ignore[return-value]


def with_gain(gain: np.ndarray, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Returns actions (N, m) that add u = gain x_hat to an agent's, within the limits.

    Args:
        gain: Normalized gain, shape (m, n).
        observations: Shape (N, entries), the first n of which are the estimate.
        actions: The agent's part, shape (N, m).
    """
    return np.clip(observations[:, : gain.shape[1]] @ gain.T + actions, -1.0, 1.0).astype(np.float32)
