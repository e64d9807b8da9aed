"""Set-point tracking: bring one output to a random piecewise-constant target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.tasks.base_task import Task
from ncs_gym.validation import as_count, as_number, as_vector

# Targets beyond the farthest equilibrium by less than this fraction are within it but for rounding.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class SetpointTracking(Task):
    """Bring one output c x to a random piecewise-constant target.

    The reward is 1 - min(|c x - target| / width, 1) at the end of the step, so that every step survived pays, less
    `change_price` times the change of the input in units of its limit (of several inputs the mean). The observation
    gains the target, the targets of the next `preview` steps and, where its changes have a price, the last input. The
    task's state is the target, a number or shape (N,); with a preview or a price it holds the targets, the last input
    and what it was changed by, shape (k,) or (k, N). A plant without an equilibrium at the outermost target within its
    limits is refused.

    Attributes:
        output: The row c of the output c x that follows the target, shape (n,).
        reach: Targets are uniform in [-reach, reach], in the unit of c x.
        width: The error |c x - target| from which on a step pays nothing, in the unit of c x.
        change_probability: Probability per step that a new target is drawn.
        preview: Number of steps ahead that targets are known.
        change_price: What a change of the input by its limit costs in a step.

    Raises:
        ValueError: If a value is out of range.
    """

    output: np.ndarray
    reach: float
    width: float
    change_probability: float = 0.02
    preview: int = 0
    change_price: float = 0.0
    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        output = [self.output] if isinstance(self.output, int | float) else self.output
        object.__setattr__(self, "output", as_vector(output, None, "output"))
        for name in ("reach", "width"):
            object.__setattr__(self, name, as_number(getattr(self, name), name, low=0.0, low_open=True))
        probability = as_number(self.change_probability, "change_probability", low=0.0, high=1.0)
        object.__setattr__(self, "change_probability", probability)
        object.__setattr__(self, "preview", as_count(self.preview, "preview", low=0, high=1000))
        object.__setattr__(self, "change_price", as_number(self.change_price, "change_price", low=0.0))
        self._make_arrays_read_only()

    def target(self, task_state: Any) -> Any:
        """Returns the target now, a number or shape (N,)."""
        return task_state[0] if self._is_extended else task_state

    def begin(self, rng, plant, size=None):  # noqa: D102
        targets = [self.reach * (2.0 * rng.random(size) - 1.0)]
        if not self._is_extended:
            return targets[0]
        for _ in range(self.preview):
            targets.append(self._next(rng, targets[-1]))
        kept = plant.m + 1 if self.change_price else 0
        return np.concatenate([targets, np.zeros((kept, *np.shape(targets[0])))])

    def advance(self, rng, plant, task_state, u):  # noqa: D102
        if not self._is_extended:
            return self._next(rng, task_state)
        moved = self.predict(plant, task_state, u)
        moved[self.preview] = self._next(rng, task_state[self.preview])
        return moved

    def predict(self, plant, task_state, u):  # noqa: D102
        if not self._is_extended:
            return task_state
        moved, last = np.array(task_state), self.preview + 1
        moved[: last - 1] = task_state[1:last]
        if self.change_price:
            moved[last:-1] = u
            moved[-1] = np.abs((u - task_state[last:-1]).T / plant.input_half).mean(axis=-1)
        return moved

    def observe(self, task_state):  # noqa: D102
        if not self._is_extended:
            return np.asarray(task_state)[None]
        return task_state[:-1] if self.change_price else task_state

    def observation_bound(self, plant, horizon):  # noqa: D102
        targets = np.full(1 + self.preview, self.reach)
        return np.concatenate([targets, plant.largest_input]) if self.change_price else targets

    def reward(self, plant, task_state, state, u):  # noqa: D102
        near = 1.0 - np.minimum(abs(self.output.dot(state) - self.target(task_state)) / self.width, 1.0)
        return near - self.change_price * task_state[-1] if self.change_price else near

    def check(self, plant):  # noqa: D102
        if self.output.shape != (plant.n,):
            return f"output must have shape ({plant.n},), got {self.output.shape}"
        if _smallest_equilibria_hold(plant, self.output, self.reach):
            return ""
        farthest = farthest_equilibrium(plant, self.output)
        if self.reach > farthest * (1.0 + _ROUNDING):
            return (
                f"targets reach {self.reach:g}, but the farthest equilibrium inside the safe box and the input limits "
                f"has c x = {farthest:z.6g}: no controller can hold what lies beyond"
            )
        return ""

    @property
    def _is_extended(self) -> bool:
        return self.preview > 0 or self.change_price > 0.0

    def _next(self, rng: np.random.Generator, target: Any) -> Any:
        """Returns the targets of the step after those given."""
        chance, drawn = rng.random((2, *np.shape(target)))
        return np.where(chance < self.change_probability, self.reach * (2.0 * drawn - 1.0), target)[()]


def _smallest_equilibria_hold(plant: LinearPlant, output: np.ndarray, reach: float) -> bool:
    """Returns whether the smallest states and inputs at rest with c x = +-reach are within the limits.

    That is enough, and takes no linear program.
    """
    scale = np.concatenate([plant.half_widths, plant.input_half])
    balance = np.hstack([np.eye(plant.n) - plant.A, -plant.B]) / plant.half_widths[:, None]
    rows = np.vstack([balance, np.concatenate([output, np.zeros(plant.m)])]) * scale
    wanted = np.concatenate([np.zeros(plant.n), [reach]])
    smallest = np.linalg.lstsq(rows, wanted)[0]
    if not np.abs(rows @ smallest - wanted).max() <= _ROUNDING * reach:
        return False
    (x, u), (low, high) = np.split(scale * smallest, [plant.n]), plant.input_ends
    return all(
        (plant.constraint_values(sign * x) <= 0.0).all() and (low <= sign * u).all() and (sign * u <= high).all()
        for sign in (1.0, -1.0)
    )


def farthest_equilibrium(plant: LinearPlant, output: np.ndarray) -> float:
    """Returns up to where c x = +-r, c of shape (n,), holds for some x = A x + B u within the limits, or infinity."""
    from scipy.optimize import linprog  # takes long to import

    n, m = plant.n, plant.m
    rows = np.hstack([plant.box, np.zeros((len(plant.box), m))])
    scale = np.concatenate([plant.half_widths, plant.input_half])  # all variables are of the same size then
    balance = np.hstack([np.eye(n) - plant.A, -plant.B]) / plant.half_widths[:, None]
    low, high = plant.input_ends / plant.input_half
    farthest = np.inf
    for sign in (1.0, -1.0):
        found = linprog(
            -sign * np.concatenate([output, np.zeros(m)]) * scale,
            A_ub=np.concatenate([rows, -rows]) * scale,
            b_ub=np.concatenate([plant.box_ends[1], -plant.box_ends[0]]),
            A_eq=balance * scale,
            b_eq=np.zeros(n),
            bounds=[(None, None)] * n + list(zip(low, high, strict=True)),
        )
        farthest = min(farthest, np.inf if found.status == 3 else -float(found.fun))
    return farthest
