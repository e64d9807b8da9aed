"""Small environments that `Networked` is put around."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Counter(gym.Env):
    """Counts its steps, and repeats the action of each: what is seen tells when it was taken, and what acted.

    Args:
        kind: "vector" or "dict" observations, or "image" ones, a new array each, or "buffers", in turn in three.
        length: Steps of an episode.
    """

    action_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def __init__(self, kind: str = "vector", length: int = 10_000, extra_draws: int = 0) -> None:
        self.kind, self.length, self.extra_draws = kind, length, extra_draws
        count = spaces.Box(0.0, np.inf, (1,), np.float64)
        image = spaces.Box(0, 255, (84, 84, 4), np.uint8)
        self.observation_space = {
            "vector": count,
            "dict": spaces.Dict({"count": count, "image": image, "odd": spaces.Discrete(2)}),
            "image": image,
            "buffers": image,
        }[kind]
        self._buffers = [np.zeros((84, 84, 4), np.uint8) for _ in range(3)]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._observation(), {"options": options or {}}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.np_random.random(self.extra_draws)
        return self._observation(), float(self.steps), self.steps >= self.length, False, {"acted": float(action[0])}

    def _observation(self) -> Any:
        count = np.array([float(self.steps)])
        if self.kind == "vector":
            return count
        image = self._buffers[self.steps % 3] if self.kind == "buffers" else np.empty((84, 84, 4), np.uint8)
        image[:] = self.steps % 256
        if self.kind == "dict":
            return {"count": count, "image": image, "odd": np.int64(self.steps % 2)}
        return image


class Sampled(gym.Env):
    """Nothing moves: what is seen is drawn from a space.

    Args:
        space: Of observations.
    """

    action_space = spaces.Discrete(2)

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.observation_space, self.given = space, []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.given = [self.observation_space.sample()]
        return self.given[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.given.append(self.observation_space.sample())
        return self.given[-1], 0.0, False, False, {}


def ages_of_trace(delays, steps):
    """Ages of the newest sample at steps 0..steps, by going through all packets at each; sample k is sent at step k."""
    ages = []
    for now in range(steps + 1):
        arrived = [s for s in range(1, now + 1) if delays[s - 1] >= 0 and s + delays[s - 1] <= now]
        ages.append(now - max(arrived, default=0))
    return ages
