"""A process that moves the own states of a plant whose further states are past inputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ncs_gym.bounds import Bounds
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.process import FamilyProcess, LinearProcess, Process


def opened_for(process: Process, plant: LinearPlant, size: int | None) -> Process:
    """Returns what moves in one environment (None) or in `size`, all states of the plant.

    Its own equations do so by themselves; beside any other process its past inputs are kept.

    Raises:
        ValueError: If the process does not fit the plant.
    """
    if isinstance(process, LinearProcess | FamilyProcess) or not plant.past:
        return process.opened(plant, size)
    return _BesidePastInputs(process, plant, size)


class _BesidePastInputs(Process):
    """Moves x by a process, and the inputs under way by one step: (x, u_{k-d}, .., u_{k-1}), the oldest input first."""

    def __init__(self, process: Process, plant: LinearPlant, size: int | None) -> None:
        self._plant, self._is_late = _without_past_inputs(plant), plant.model.delays > 0
        self._inner = process.opened(self._plant, size)
        self.vectorized, self.is_written = size is not None, self._inner.is_written

    @property
    def terminated(self) -> Any:
        return self._inner.terminated

    @property
    def truncated(self) -> Any:
        return self._inner.truncated

    @property
    def parameters(self) -> np.ndarray | None:
        return self._inner.parameters

    def read_parameters(self, given: Any, *, anywhere: bool = False) -> np.ndarray | None:
        return self._inner.read_parameters(given, anywhere=anywhere)

    def choose(self, rng: np.random.Generator, chosen: np.ndarray | None, fixed: np.ndarray | None) -> None:
        self._inner.choose(rng, chosen, fixed)

    def start(self, rng: np.random.Generator, state: np.ndarray, chosen: np.ndarray | None) -> np.ndarray:
        own, past = np.split(state, [self._plant.n])
        return np.concatenate([self._inner.start(rng, own, chosen), past])

    def step(self, plant: LinearPlant, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        (own, past), m = np.split(state, [self._plant.n]), self._plant.m
        move = self._inner.step_many if self.vectorized else self._inner.step
        return np.concatenate([move(self._plant, own, past[:m] if self._is_late else u), past[m:], u])

    def write(self, state: np.ndarray) -> np.ndarray:
        own, past = np.split(state, [self._plant.n])
        return np.concatenate([self._inner.write(own), past])

    def close(self) -> None:
        self._inner.close()


def _without_past_inputs(plant: LinearPlant) -> LinearPlant:
    """Returns the plant of the own states alone, of which nothing uncertain is declared."""
    point = plant.operating_state[: plant.n - plant.past], plant.operating_input
    model = replace(plant.model, at=point, offset=None, delays=0)
    limits = replace(plant.limits.absolute(plant.model), rate=None)
    return LinearPlant(model, limits, Bounds(disturbance=0.0, sensor=0.0, first_error=0.0), plant.labels)
