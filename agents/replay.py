"""A replay buffer of what was applied: behind a shield critics then learn about actions that happened."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer

# The info that says what was applied; in its place `SB3VecEnv` has to be asked for it.
APPLIED = "input_committed"


class AppliedActionBuffer(ReplayBuffer):
    """Stores, in the place of the agent's action, the one that the shield let through.

    Hand it to SAC, TD3 and their kind as `replay_buffer_class`, with `replay_buffer_kwargs={"limits": plant.u_max}`;
    `SB3VecEnv` needs `info_keys=("input_committed",)`. `train` does so with the hyperparameter
    `stored_action="applied"`.

    Args:
        arguments: Those of `ReplayBuffer`.
        limits: u_max, shape (m,), which actions are in units of.
        keywords: Those of `ReplayBuffer`.
    """

    def __init__(self, *arguments: Any, limits: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self._limits = np.asarray(limits, dtype=np.float64)

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Adds a transition of every environment.

        Raises:
            ValueError: If infos do not say what was applied.
        """
        if any(APPLIED not in info for info in infos):
            raise ValueError(f'infos have no "{APPLIED}": make SB3VecEnv(..., info_keys=("{APPLIED}",))')
        applied = np.array([info[APPLIED] for info in infos]) / self._limits
        super().add(obs, next_obs, applied.reshape(action.shape).astype(action.dtype), reward, done, infos)
