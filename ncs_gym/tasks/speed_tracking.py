"""Speed tracking: follow a random piecewise-constant speed profile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ncs_gym.tasks.base_task import Task
from ncs_gym.validation import as_count, as_number


@dataclass(frozen=True, eq=False, kw_only=True)
class SpeedTracking(Task):
    """Follow a random piecewise-constant speed profile with a vehicle whose acceleration is an input.

    The speed moves by v+ = v + dt u. The observation gains the speed error, target - v [m/s]. The reward is
    -error_weight min(|error| / 5, 5) - input_weight u^2, at the end of the step. The task's state holds the vehicle's
    speed and its target [m/s], shape (2,) or (2, N).

    Attributes:
        fastest: Targets (and the first speed) are uniform in `[0, fastest]` [m/s].
        change_probability: Probability per step that a new target is drawn.
        error_weight: What 5 m/s of speed error cost in a step.
        input_weight: What an acceleration of 1 m/s^2 costs in a step.
        input_index: Which input is the acceleration [m/s^2].

    Raises:
        ValueError: If a value is out of range.
    """

    fastest: float = 25.0
    change_probability: float = 0.02
    error_weight: float = 0.2
    input_weight: float = 0.002
    input_index: int = 0
    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        fastest = as_number(self.fastest, "fastest", low=0.0, low_open=True)
        probability = as_number(self.change_probability, "change_probability", low=0.0, high=1.0)
        for name, value in (
            ("fastest", fastest),
            ("change_probability", probability),
            ("error_weight", as_number(self.error_weight, "error_weight", low=0.0)),
            ("input_weight", as_number(self.input_weight, "input_weight", low=0.0)),
            ("input_index", as_count(self.input_index, "input_index", low=0)),
        ):
            object.__setattr__(self, name, value)

    def begin(self, rng, plant, size=None):  # noqa: D102
        return self.fastest * rng.random((2,) if size is None else (2, size))

    def advance(self, rng, plant, task_state, u):  # noqa: D102
        speed, target = _entries(task_state)
        # One draw decides whether the target changes, and where to: below p, chance / p is uniform.
        chance, p = rng.random(task_state.shape[1:] or None), self.change_probability
        drawn = chance * (self.fastest / p if p > 0.0 else 0.0)
        target = target + (chance < p) * (drawn - target)
        return np.array([speed + plant.dt * u[self.input_index], target])

    def predict(self, plant, task_state, u):  # noqa: D102
        speed, target = task_state
        return np.array([speed + plant.dt * u[self.input_index], target])

    def observe(self, task_state):  # noqa: D102
        return task_state[1:] - task_state[:1]

    def observation_bound(self, plant, horizon):  # noqa: D102
        return np.array([self.fastest + horizon * plant.dt * plant.largest_input[self.input_index]])

    def reward(self, plant, task_state, state, u):  # noqa: D102
        speed, target = _entries(task_state)
        error, effort = abs(target - speed), u[self.input_index]
        return -self.error_weight * np.minimum(error / 5.0, 5.0) - self.input_weight * effort * effort

    def check(self, plant):  # noqa: D102
        if self.input_index >= plant.m:
            return f"input_index must be < {plant.m}, got {self.input_index}"
        if plant.model.delays.any():
            return "inputs of a plant with delays act later than the task's speed moves: give it as a downlink"
        if (center := float(plant.operating_input[self.input_index])) != 0.0:
            return f"the input is an acceleration, which the operating point must count from zero, got {center:g}"
        return ""


def _entries(task_state: np.ndarray) -> Any:
    """Returns speed and target: of one vehicle as numbers, which are added in a third of the time."""
    return task_state.tolist() if task_state.ndim == 1 else task_state
