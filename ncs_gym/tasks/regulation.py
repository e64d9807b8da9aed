"""Regulation: keep the state near zero."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.tasks.base_task import Task
from ncs_gym.validation import as_covariance


@dataclass(frozen=True, eq=False, kw_only=True)
class Regulation(Task):
    """Keep the state near zero: reward -(x'Qx + u'Ru) with the true next state x and the input applied.

    Attributes:
        state_cost: Q, shape (n, n); None: C'C, so that the edge of the safe box costs about 1. Rows C of past inputs
            are left out.
        input_cost: R, shape (m, m); None: 0.01 diag(1 / h^2), h half the range of the inputs.

    Raises:
        ValueError: If a cost is not symmetric positive semidefinite.
    """

    state_cost: np.ndarray | None = None
    input_cost: np.ndarray | None = None
    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name in ("state_cost", "input_cost"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, as_covariance(value, None, name))
        self._make_arrays_read_only()

    def costs(self, plant: LinearPlant) -> tuple[np.ndarray, np.ndarray]:
        """Returns Q, shape (n, n), and R, (m, m), for a plant."""
        return _costs(self, plant)

    def reward(self, plant, task_state, state, u):  # noqa: D102
        Q, R = _costs(self, plant)
        return -np.add.reduce(state * (Q @ state)) - np.add.reduce(u * (R @ u))

    def check(self, plant):  # noqa: D102
        for name, size in (("state_cost", plant.n), ("input_cost", plant.m)):
            value = getattr(self, name)
            if value is not None and value.shape != (size, size):
                return f"{name} must have shape ({size}, {size}), got {value.shape}"
        return ""


@lru_cache(maxsize=64)
def _costs(task: Regulation, plant: LinearPlant) -> tuple[np.ndarray, np.ndarray]:
    box = plant.box[~plant.is_past_row]
    Q = box.T @ box if task.state_cost is None else task.state_cost
    R = np.diag(0.01 / plant.input_half**2) if task.input_cost is None else task.input_cost
    return Q, R
