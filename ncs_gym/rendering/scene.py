"""What one picture shows, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ncs_gym.estimation.estimator import Estimator
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering.annotation import Annotation
from ncs_gym.rendering.history import Flight, History
from ncs_gym.tasks.setpoint_tracking import SetpointTracking
from ncs_gym.tasks.speed_tracking import SpeedTracking
from ncs_gym.tasks.task import Task


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What the task wants of one quantity.

    Attributes:
        name: Of the quantity.
        unit: Of both numbers.
        value: True value now.
        target: Wanted value.
        low, high: Range of the targets.
    """

    name: str
    unit: str
    value: float
    target: float
    low: float
    high: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """Everything in a picture; the painters read nothing else.

    Attributes:
        plant: With names, units and limits.
        step: Steps taken in this episode.
        state: x, shape (n,).
        estimate: x_hat, shape (n,).
        error_shape: Sigma_k, shape (n, n).
        input: Applied in the step that led here, shape (m,); None at reset.
        violations: Steps of this episode with a violation.
        violated: Whether the true state violates the safe box now.
        age: Steps since the newest sample used was taken.
        path: Recent states, oldest first, shape (T, n).
        acted: Whether the shield overrode the step that led to each of them, shape (T,).
        flights: Recent packets, oldest first.
        annotation: The shield's; None without one.
        goal: The task's, where it is about one quantity.
        distance: Driven in this episode, where the task knows a speed [m].
    """

    plant: LinearPlant
    step: int
    state: np.ndarray
    estimate: np.ndarray
    error_shape: np.ndarray
    input: np.ndarray | None
    violations: int
    violated: bool
    age: int
    path: np.ndarray
    acted: np.ndarray
    flights: tuple[Flight, ...]
    annotation: Annotation | None
    goal: Goal | None
    distance: float

    @property
    def intervened(self) -> bool:
        """Whether a shield that protects overrode the step that led here."""
        note = self.annotation
        return note is not None and note.intervened and note.protects


def scene_of(
    plant: LinearPlant, task: Task, task_memory: Any, estimator: Estimator, history: History, violations: int
) -> Scene:
    """Returns the scene at the end of a history."""
    belief, state = estimator.belief, history.moments[-1].state
    return Scene(
        plant=plant,
        step=history.step,
        state=state,
        estimate=belief.mean,
        error_shape=belief.shape,
        input=history.input,
        violations=violations,
        violated=bool(plant.constraint_values(state).max() > 0.0),
        age=estimator.age,
        path=np.array([moment.state for moment in history.moments]),
        acted=np.array([moment.acted for moment in history.moments]),
        flights=tuple(history.flights),
        annotation=history.annotation,
        goal=goal_of(task, plant, task_memory, state),
        distance=history.distance,
    )


def goal_of(task: Task, plant: LinearPlant, memory: Any, state: np.ndarray) -> Goal | None:
    """Returns what the task wants of one quantity; None for tasks that are not about one."""
    if isinstance(task, SpeedTracking):
        return Goal(
            name="speed", unit="m/s", value=float(memory[0]), target=float(memory[1]), low=0.0, high=task.fastest
        )
    if isinstance(task, SetpointTracking):
        used, name, unit = np.flatnonzero(task.output), "output", ""
        if len(used) == 1:
            name, unit = plant.state_names[int(used[0])], plant.state_units[int(used[0])]
        value = float(task.output @ state)
        return Goal(name=name, unit=unit, value=value, target=float(memory), low=-task.reach, high=task.reach)
    return None
