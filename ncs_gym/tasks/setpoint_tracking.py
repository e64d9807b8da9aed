"""Set-point tracking: bring one output to a random piecewise-constant target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ncs_gym.tasks.task import Task
from ncs_gym.validation import as_number, as_vector


@dataclass(frozen=True, eq=False, kw_only=True)
class SetpointTracking(Task):
    """Bring one output c x to a random piecewise-constant target.

    The observation gains the target. The reward is 1 - min(|c x - target| / width, 1) at the end of the step, so that
    every step survived pays. The task's state is the target, a number or shape (N,).

    Attributes:
        output: The row c of the output c x that follows the target, shape (n,).
        reach: Targets are uniform in [-reach, reach], in the unit of c x.
        width: The error |c x - target| from which on a step pays nothing, in the unit of c x.
        change_probability: Probability per step that a new target is drawn.

    Raises:
        ValueError: If a value is out of range.
    """

    output: np.ndarray
    reach: float
    width: float
    change_probability: float = 0.02
    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        output = [self.output] if isinstance(self.output, int | float) else self.output
        object.__setattr__(self, "output", as_vector(output, None, "output"))
        for name in ("reach", "width"):
            object.__setattr__(self, name, as_number(getattr(self, name), name, low=0.0, low_open=True))
        probability = as_number(self.change_probability, "change_probability", low=0.0, high=1.0)
        object.__setattr__(self, "change_probability", probability)
        self._make_arrays_read_only()

    def begin(self, rng, plant, size=None):  # noqa: D102
        return self.reach * (2.0 * rng.random(size) - 1.0)

    def advance(self, rng, plant, task_state, u):  # noqa: D102
        chance, drawn = rng.random((2, *np.shape(task_state)))
        return np.where(chance < self.change_probability, self.reach * (2.0 * drawn - 1.0), task_state)[()]

    def observe(self, task_state):  # noqa: D102
        return np.asarray(task_state)[None]

    def observation_bound(self, plant, horizon):  # noqa: D102
        return np.array([self.reach])

    def reward(self, plant, task_state, state, u):  # noqa: D102
        return 1.0 - np.minimum(abs(self.output.dot(state) - task_state) / self.width, 1.0)

    def check(self, plant):  # noqa: D102
        if self.output.shape != (plant.n,):
            return f"output must have shape ({plant.n},), got {self.output.shape}"
        return ""
