"""A process other than the linear plant, with the sensors and disturbances of the plant, and an alarm."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.simulation import PlantSimulation
from ncs_gym.uncertainty.disturbance import Disturbance
from ncs_gym.uncertainty.disturbance_settings import stays_inside
from ncs_gym.uncertainty.ellipsoid import Ellipsoid


class Body(ABC):
    """What moves, at run time, in one environment or in many of them; the last axis of every array is the environment.

    Attributes:
        is_written: Whether it can be put into a state, so that episodes start where the environment says and
            disturbances of the plant can act.
        is_vectorized: Whether `step` takes any number of states and inputs at once.
        terminated, truncated: Whether it ended the episode by itself; arrays (N,) for many environments.
    """

    is_written: bool = True
    is_vectorized: bool = False
    terminated: Any = False
    truncated: Any = False

    def start(self, rng: np.random.Generator, state: np.ndarray, chosen: np.ndarray | None) -> np.ndarray:
        """Starts episodes, and returns the states that they start in.

        Args:
            rng: Source of randomness.
            state: Where to start, shape (n,), or (n, k) for k chosen environments.
            chosen: Numbers of these environments, shape (k,); None without that axis.
        """
        return state

    @abstractmethod
    def step(self, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns the next state without disturbance, shape (n,) or (n, N), for inputs (m,) or (m, N)."""

    def write(self, state: np.ndarray) -> np.ndarray:
        """Puts everything that has not ended into a state, shape (n,) or (n, N), and returns what is read back."""
        return state

    def close(self) -> None:  # noqa: B027 - most have nothing to close
        """Closes what was opened."""


class BodySimulation(PlantSimulation):
    """x+ = f(x, u) + d, sensors and disturbances as in `PlantSimulation`, d within what is declared beside a remainder.

    Args:
        body: What moves.
        plant: The certified model.
        disturbance: What acts on it beyond the remainder; nothing if the plant declares no more than that, or if the
            body cannot be put into a state: what the plant declares is then the body's own.
        allow_assumption_violation: Let disturbances outside the certified bound pass instead of raising.
        size: Number of environments; None for one without that axis.
        truncated: Whether noise is truncated.

    Attributes:
        alarm: Whether x+ - A x - B u lay outside E(D) in a step of this episode, so that no proof about the model is
            one about the process; shape (N,) for many environments.

    Raises:
        ValueError: If a disturbance of the user's cannot act on the body.
    """

    def __init__(
        self,
        body: Body,
        plant: LinearPlant,
        disturbance: Disturbance,
        allow_assumption_violation: bool,
        size: int | None = None,
        *,
        truncated: bool = True,
    ) -> None:
        acting = plant.without_remainder
        super().__init__(acting, disturbance, allow_assumption_violation, size, truncated=truncated)
        self._body, self._model = body, plant
        own = stays_inside(disturbance)
        if not own and not body.is_written:
            raise ValueError("a disturbance of your own can act only on a process with write_state: give it one")
        self._is_disturbed = body.is_written and (not own or bool(np.any(acting.nominal_disturbance.shape)))
        self.alarm = False if size is None else np.zeros(size, np.bool_)

    @property
    def terminated(self) -> Any:
        """Whether the process ended the episode, a bool or shape (N,)."""
        return self._body.terminated

    @property
    def truncated(self) -> Any:
        """Whether the process cut the episode off, a bool or shape (N,)."""
        return self._body.truncated

    def start(
        self, rng: np.random.Generator, state: np.ndarray, initial: Ellipsoid | None
    ) -> tuple[np.ndarray, Ellipsoid | np.ndarray]:
        """Starts an episode; a start outside the initial set is known as the state itself.

        Raises:
            ValueError: If the process cannot start at a given state.
        """
        self._require_written(initial)
        started = self._body.start(rng, state, None)
        self.alarm = False
        if initial is not None and initial.contains(started):
            return started, initial
        return super().start(rng, started, None)

    def start_many(
        self, rng: np.random.Generator, states: np.ndarray, initial: Ellipsoid | None, mask: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Starts the episodes that a mask chooses; starts outside the initial set are known as the states themselves.

        Raises:
            ValueError: If the process cannot start at given states.
        """
        self._require_written(initial)
        started = self._body.start(rng, states, np.flatnonzero(mask))
        self.alarm = self.alarm & ~mask
        known = started.T.copy()
        if initial is not None:
            known[initial.gauge(started.T) <= 1.0] = np.nan
        return started, known

    def advance(self, rng: np.random.Generator, state: np.ndarray, u: np.ndarray, steps: Any, memory: Any) -> Any:
        """Returns the next state; see `PlantSimulation.advance`."""
        linear = self._model.A.dot(state) + self._model.B.dot(u)
        moved = self._body.step(state, u)
        if self._is_disturbed:
            moved = moved + self.draw_disturbance(rng, moved, steps, memory)
        if self._body.is_written and self._limit is not None:
            moved = np.minimum(np.maximum(moved, -self._limit), self._limit)
        if self._is_disturbed:
            moved = self._body.write(moved)
        gauge = self._model.disturbance.gauge((moved - linear).T)  # NaN where it overflows
        self.alarm = self.alarm | ((gauge <= 1.0) == False)  # noqa: E712
        return moved

    def close(self) -> None:
        """Closes what the process opened."""
        self._body.close()

    def _require_written(self, initial: Ellipsoid | None) -> None:
        if initial is None and not self._body.is_written:
            raise ValueError("this process cannot start at a given state: give its GymProcess write_state")
