"""When the episodes of N loops that ended begin anew: a layer around loops that only move and begin."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from ncs_gym.validation import shown

Begun = tuple[np.ndarray, dict[str, Any]]
Moved = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]


class Autoreset:
    """Begins episodes after those that ended, as gymnasium's modes say.

    Args:
        mode: `AutoresetMode`, or its name.
        count: N.

    Attributes:
        mode: The mode.
        over: Which episodes are over, shape (N,).

    Raises:
        ValueError: If there is no such mode.
    """

    def __init__(self, mode: AutoresetMode | str, count: int) -> None:
        modes = {each.value: each for each in AutoresetMode}
        name = mode.value if isinstance(mode, AutoresetMode) else mode
        if not (isinstance(name, str) and name in modes):
            raise ValueError(f"autoreset_mode must be one of {[*modes]}, got {shown(mode)}")
        self.mode = modes[name]
        self._nothing = self.over = np.zeros(count, np.bool_)

    def require_under_way(self) -> None:
        """Raises ResetNeeded if an episode is over and nobody but the caller begins another one."""
        if self.mode is AutoresetMode.DISABLED and np.count_nonzero(self.over):
            raise gym.error.ResetNeeded("some episodes are over: reset them with options={'reset_mask': ...}")

    def step(self, move: Callable[[], Moved], begin: Callable[[np.ndarray], Begun]) -> Moved:
        """Returns what a step returns.

        Args:
            move: Moves all loops one step, also those whose episode is over.
            begin: Begins episodes where a mask, shape (N,), says so; returns first observations and infos.
        """
        observation, reward, terminated, truncated, info = move()
        if np.count_nonzero(self.over):  # NEXT_STEP: the last step ended these episodes
            first, fresh = begin(self.over)
            observation, info = _merged(self.over, first, observation), _merged_infos(self.over, fresh, info)
            reward[self.over] = 0.0
            terminated, truncated = terminated & ~self.over, truncated & ~self.over
        self.over = terminated | truncated
        if self.mode is AutoresetMode.SAME_STEP and np.count_nonzero(self.over):
            done, self.over = self.over, self._nothing
            blank = {key: np.full_like(value, "" if value.dtype == object else 0) for key, value in info.items()}
            final = _merged_infos(done, info, blank) | {f"_{key}": done.copy() for key in info}
            first, fresh = begin(done)
            info = _merged_infos(done, fresh, info) | {
                "final_obs": _merged(done, observation, np.zeros_like(observation)),
                "_final_obs": done.copy(),
                "final_info": final,
                "_final_info": done.copy(),
            }
            observation = _merged(done, first, observation)
        return observation, reward, terminated, truncated, info


def _merged(mask: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.where(mask.reshape(-1, *[1] * (first.ndim - 1)), first, second)


def _merged_infos(mask: np.ndarray, first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    return {key: _merged(mask, value, second[key]) for key, value in first.items()}
