"""Normalization of observations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize


@dataclass(frozen=True, eq=False)
class Normalization:
    """Normalizes observations: clip((o - mean) / sqrt(variance + epsilon), -clip, clip).

    Attributes:
        mean: Mean of the observations in training, shape (entries,).
        variance: Their variance, shape (entries,).
        epsilon: Keeps the root away from 0.
        clip: Largest absolute value of a normalized entry.
    """

    mean: np.ndarray
    variance: np.ndarray
    epsilon: float
    clip: float

    @classmethod
    def of(cls, env: VecNormalize) -> Normalization:
        """Returns the present statistics of a `VecNormalize`.

        Raises:
            TypeError: If its observations are dictionaries.
        """
        statistics = env.obs_rms
        if isinstance(statistics, dict):
            raise TypeError("observations must be one array, got a dictionary of them")
        return cls(statistics.mean.copy(), statistics.var.copy(), float(env.epsilon), float(env.clip_obs))

    @classmethod
    def none(cls, entries: int) -> Normalization:
        """Returns that which leaves observations as they are."""
        return cls(np.zeros(entries), np.ones(entries), 0.0, float("inf"))

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Returns normalized observations (N, entries), float32."""
        scaled = (observations - self.mean) / np.sqrt(self.variance + self.epsilon)
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)
