"""Linear controllers of the registered tasks: action = clip((gain x_hat + task_gain y) / u_max), y the task's entry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ncs_gym import LinearPlant, Regulation, SetpointTracking, SpeedTracking
from ncs_gym.plants.lqr import lqr_gain
from ncs_gym.tasks.base_task import Task

EFFORTS = tuple(10.0**power for power in (-4, -3, -2, -1, 0))
# Weights of the safe box beside that of the task's own error.
BOX_WEIGHTS = (1e-2, 1e-1, 1.0)
# The target that a controller follows is the present one, or one of those that the task shows ahead.
TARGETS_AHEAD = (0, 1, 2, 4, 8)
PROPORTIONAL_GAINS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 4.0)


@dataclass(frozen=True, eq=False)
class LinearController:
    """A linear controller.

    Attributes:
        name: Kind and weights.
        gain: Shape (m, n).
        task_gain: Shape (m, entries), for the entries that the task adds to the observation.
    """

    name: str
    gain: np.ndarray
    task_gain: np.ndarray

    def policy(self, plant: LinearPlant) -> Callable[..., np.ndarray]:
        """The policy that `agents.evaluate` takes."""

        def act(observations: np.ndarray, infos: dict[str, np.ndarray]) -> np.ndarray:
            inputs = infos["estimate"] @ self.gain.T + observations[:, plant.n :] @ self.task_gain.T
            return np.clip(inputs / plant.u_max, -1.0, 1.0)

        return act


def linear_controllers(plant: LinearPlant, task: Task) -> list[LinearController]:
    """The candidates among which the best linear controller of a task is chosen."""
    if isinstance(task, SpeedTracking):
        return _proportional(plant, task) + _speed_regulators(plant, task)
    if isinstance(task, SetpointTracking):
        return _setpoint_regulators(plant, task)
    assert isinstance(task, Regulation)
    weights = plant.box_rows.T @ plant.box_rows
    efforts = [effort * np.diag(1.0 / plant.u_max**2) for effort in EFFORTS]
    return [
        LinearController(f"LQR, effort {effort:g}", regulator(plant.A, plant.B, weights, R), np.zeros((plant.m, 0)))
        for effort, R in zip(EFFORTS, efforts, strict=True)
    ]


def regulator(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """K, shape (m, n), of u = K x that minimizes the sum of x'Qx + u'Ru."""
    gain = lqr_gain(A, B, Q, R)
    assert gain is not None
    return gain


def setpoint(plant: LinearPlant, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State and input, shapes (n,) and (m,), at rest with output 1: those that use the least of box and limits."""
    n, m = plant.n, plant.m
    rest = np.hstack([np.eye(n) - plant.A, -plant.B])
    equations, sides = np.vstack([rest, np.append(output, np.zeros(m))]), np.append(np.zeros(n), 1.0)
    widths = np.append(np.diag(np.linalg.inv(plant.box_rows.T @ plant.box_rows)) ** 0.5, plant.u_max)
    solution = widths * np.linalg.lstsq(equations * widths, sides)[0]
    return solution[:n], solution[n:]


def _setpoint_regulators(plant: LinearPlant, task: SetpointTracking) -> list[LinearController]:
    state, held = setpoint(plant, task.output)
    found, entries = [], len(task.observation_bound(plant, 1))
    for effort in EFFORTS:
        for weight in BOX_WEIGHTS:
            Q = np.outer(task.output, task.output) / task.width**2 + weight * plant.box_rows.T @ plant.box_rows
            gain = regulator(plant.A, plant.B, Q, effort * np.diag(1.0 / plant.u_max**2))
            for ahead in [each for each in TARGETS_AHEAD if each <= task.preview]:
                feed = np.zeros((plant.m, entries))
                feed[:, ahead] = held - gain @ state
                name = f"LQR, effort {effort:g}, box {weight:g}, target {ahead} steps ahead"
                found.append(LinearController(name, gain, feed))
    return found


def _proportional(plant: LinearPlant, task: SpeedTracking) -> list[LinearController]:
    direction = np.eye(plant.m)[:, task.input_index : task.input_index + 1]
    return [
        LinearController(f"proportional, {gain:g} / s", np.zeros((plant.m, plant.n)), gain * direction)
        for gain in PROPORTIONAL_GAINS
    ]


def _speed_regulators(plant: LinearPlant, task: SpeedTracking) -> list[LinearController]:
    """LQRs of the plant and the speed error e, e+ = e - dt u."""
    n, found = plant.n, []
    A = np.eye(n + 1)
    A[:n, :n] = plant.A
    row = -plant.dt * np.eye(plant.m)[task.input_index]
    B = np.vstack([plant.B, row])
    for effort in EFFORTS:
        for weight in (0.0, *BOX_WEIGHTS):
            Q = np.zeros((n + 1, n + 1))
            Q[:n, :n], Q[n, n] = weight * plant.box_rows.T @ plant.box_rows, 1.0 / 25.0
            gain = regulator(A, B, Q, effort * np.diag(1.0 / plant.u_max**2))
            found.append(LinearController(f"LQR, effort {effort:g}, box {weight:g}", gain[:, :n], gain[:, n:]))
    return found
