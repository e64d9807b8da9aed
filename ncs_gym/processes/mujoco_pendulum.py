"""Gymnasium's MuJoCo environment `InvertedPendulum-v5`: the process, and its linear model from samples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ncs_gym.bounds import Bounds
from ncs_gym.installation import install_command
from ncs_gym.limits import Limits
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.gym_process import GymProcess
from ncs_gym.processes.linearization import linear_model
from ncs_gym.processes.process import Process
from ncs_gym.validation import ReadOnlyArrays, as_number

# Safe box: position [m], angle [rad], speed [m/s], angular rate [rad/s]. The rail ends at 1 m; beyond 0.2 rad the
# environment ends its episodes.
BOX = (0.8, 0.15, 1.5, 1.5)
# Largest action, in units of 100 N, and duration of a step [s], of the environment.
LARGEST, STEP = 3.0, 0.04


@dataclass(frozen=True, kw_only=True)
class InvertedPendulumProcess(ReadOnlyArrays, Process):
    """Gymnasium's `InvertedPendulum-v5`: x = (position [m], angle [rad], speed [m/s], angular rate [rad/s]).

    Attributes:
        mass_factor: Factor of the pole's mass and inertia.

    Raises:
        ValueError: If it is not positive.
    """

    mass_factor: float = 1.0

    def __post_init__(self) -> None:
        self._check(as_number, "mass_factor", low=0.0, low_open=True)

    def opened(self, plant: LinearPlant, size: int | None) -> Process:
        """Returns the opened environments; raises ModuleNotFoundError if MuJoCo is missing."""
        if find_spec("mujoco") is None:
            raise ModuleNotFoundError(f"InvertedPendulum-v5 needs MuJoCo: {install_command('mujoco')}")
        return GymProcess(self._make, read_state=_read, write_state=_write).opened(plant, size)

    def _make(self) -> gym.Env:
        env: Any = gym.make("InvertedPendulum-v5", disable_env_checker=True).unwrapped
        pole = env.model.body("pole").id
        env.model.body_mass[pole] *= self.mass_factor
        env.model.body_inertia[pole] *= self.mass_factor
        return env


def _read(env: Any) -> np.ndarray:
    return np.concatenate([env.data.qpos, env.data.qvel])


def _write(env: Any, state: np.ndarray) -> None:
    env.set_state(state[:2], state[2:])


@lru_cache(maxsize=1)
def inverted_pendulum() -> LinearPlant:
    """Returns the linear model of `InvertedPendulum-v5`, of assumed remainder.

    The numbers are those that `sampled_inverted_pendulum` found once, so that they are the same on every machine.
    """
    return LinearPlant.load(Path(__file__).with_name("inverted_pendulum.json"))


def sampled_inverted_pendulum() -> LinearPlant:
    """Returns the same model, found anew; raises ModuleNotFoundError if MuJoCo is missing."""
    noise = 5e-4 * np.array(BOX)
    labels = {
        "states": {"position": "m", "angle": "rad", "speed": "m/s", "angular rate": "rad/s"},
        "inputs": {"force": "100 N"},
    }
    limits, bounds = Limits(state=BOX, input=LARGEST), Bounds(disturbance=0.0, sensor=noise, first_error=noise)
    return linear_model(InvertedPendulumProcess(), limits, bounds, STEP, labels=labels)
