"""What really moves, as a setting of the environment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.body_simulation import Body, BodySimulation
from ncs_gym.processes.simulation import PlantSimulation
from ncs_gym.uncertainty.disturbance import Disturbance


class Process(ABC):
    """What really moves; the plant is the certified model of it (docs/beyond_linear.md).

    Settings without run-time state: one object may serve any number of environments.
    """

    @abstractmethod
    def body(self, plant: LinearPlant, size: int | None) -> Body:
        """Returns what moves in one environment (None) or in `size` of them.

        Raises:
            ValueError: If the process does not fit the plant.
        """

    def with_mass(self, factor: float) -> Process:
        """Returns the process with another mass, for experiments in which the model is wrong.

        Args:
            factor: Of the pendulum's or the pole's mass.

        Raises:
            ValueError: If it has none.
        """
        raise ValueError(f"a {type(self).__name__} has no mass to change")

    def simulation(
        self,
        plant: LinearPlant,
        disturbance: Disturbance,
        allow_assumption_violation: bool,
        size: int | None = None,
        *,
        truncated: bool = True,
    ) -> PlantSimulation:
        """Returns the process with its sensors and disturbances; see `PlantSimulation` for the arguments."""
        body = self.body(plant, size)
        return BodySimulation(body, plant, disturbance, allow_assumption_violation, size, truncated=truncated)


@dataclass(frozen=True)
class LinearProcess(Process):
    """The plant's own equations and disturbances: the certified model is the truth."""

    def body(self, plant: LinearPlant, size: int | None) -> Body:
        """Returns the equations alone."""
        return _LinearBody(plant)

    def simulation(self, *arguments: Any, **keywords: Any) -> PlantSimulation:
        """Returns the simulation of the plant's equations, which needs no body."""
        return PlantSimulation(*arguments, **keywords)


class _LinearBody(Body):
    """x+ = A x + B u."""

    def __init__(self, plant: LinearPlant) -> None:
        self._plant = plant

    def step(self, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        return self._plant.A.dot(state) + self._plant.B.dot(u)
