"""Normalization of observations, and the files of `VecNormalize`, of which numbers alone are read."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from agents.agent_file import AgentError
from agents.pickled_data import Made, array_of, pickled_data
from ncs_gym.reading import read_file
from ncs_gym.validation import reason_of

_STATISTICS = re.compile(r"vec_?normalize", re.IGNORECASE)
_VEC_NORMALIZE = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize"


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


def statistics_beside(path: Path) -> Path | None:
    """Returns a file of `VecNormalize` in the folder of a zip, or in a folder in it, as rl-zoo3 has it; None for none.

    Of several it is the one whose name is most like the zip's, as a callback for checkpoints names them.
    """
    found = [file for file in [*path.parent.glob("*"), *path.parent.glob("*/*")] if _STATISTICS.search(file.name)]
    digits = re.findall(r"\d+", path.stem)
    files = sorted(file for file in found if file.is_file())
    return min(files, key=lambda file: (re.findall(r"\d+", file.stem) != digits, len(file.parts)), default=None)


def read_statistics(path: Path) -> Normalization | None:
    """Returns what a file that `VecNormalize.save` wrote says of observations; None if it leaves them as they are.

    Raises:
        AgentError: If it is no such file, or of observations that are no single array.
    """
    try:
        saved = pickled_data(read_file(path))
        if not isinstance(saved, Made) or saved.name != _VEC_NORMALIZE:
            raise ValueError(f"it is of {getattr(saved, 'name', '') or type(saved).__name__}")
        return _statistics(saved.attributes)
    except OSError as error:
        raise AgentError(f"cannot read {path}: {error.strerror}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise AgentError(f"{path} has no statistics that VecNormalize.save wrote: {reason_of(error)}") from error


def _statistics(saved: dict[str, Any]) -> Normalization | None:
    if saved["norm_obs"] is False:
        return None
    running = saved["obs_rms"]
    if not isinstance(running, Made):
        raise ValueError("its observations are no single array")
    mean, variance = (array_of(running.attributes[name]) for name in ("mean", "var"))
    epsilon, clip = (float(array_of(saved[name])) for name in ("epsilon", "clip_obs"))
    usable = mean.shape == variance.shape and mean.ndim == 1 and np.isfinite([mean, variance]).all()
    if not (usable and (variance >= 0.0).all() and 0.0 <= epsilon < np.inf and clip > 0.0):
        raise ValueError("a mean, a variance, epsilon or the largest value is out of range")
    if not (variance + epsilon > 0.0).all():
        raise ValueError("a variance is zero")
    return Normalization(mean, variance, epsilon, clip)
