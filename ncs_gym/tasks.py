"""What an agent is rewarded for, and the extra states that belong to it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from math import nan
from typing import Any, ClassVar

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import (
    Shared,
    as_count,
    as_covariance,
    as_number,
    as_vector,
    guarded,
    shown,
    storing_nothing,
)


class Task(Shared, ABC):
    """A reward, and perfectly known extra entries of the observation.

    `begin` draws the task's state for an episode, `advance` moves it one step; neither stores anything in the object,
    which any number of environments share (`vectorized` says whether methods take many at once).
    """

    def advance(self, rng: np.random.Generator, plant: LinearPlant, task_state: Any, u: np.ndarray) -> Any:
        """Returns the task's state after input u, shape (m,) or (m, N), was applied for one step."""
        return task_state

    def predict(self, plant: LinearPlant, task_state: Any, u: np.ndarray) -> Any:
        """Returns what is known of the task's state after an input that is already decided, (m,) or (m, N), is applied.

        Behind a downlink observations belong to the time at which the next input takes effect. Unchanged by default.
        """
        return task_state

    def observe(self, task_state: Any) -> np.ndarray:
        """Returns the extra observation entries, shape (extra,) or (extra, N)."""
        return np.zeros((0, *np.shape(task_state)[1:]))

    def observation_bound(self, plant: LinearPlant, horizon: int) -> np.ndarray:
        """Returns the largest size of each extra entry within `horizon` steps, shape (extra,), where it is clipped."""
        return np.zeros(0)

    @abstractmethod
    def reward(self, plant: LinearPlant, task_state: Any, state: np.ndarray, u: np.ndarray) -> Any:
        """Returns the reward of a step, a float or shape (N,).

        Args:
            plant: The plant.
            task_state: The task's state at the end of the step.
            state: True state at the end of the step, shape (n,) or (n, N).
            u: Input that was applied, shape (m,) or (m, N).
        """

    def advance_many(
        self, rng: np.random.Generator, plant: LinearPlant, task_state: np.ndarray, u: np.ndarray
    ) -> np.ndarray:
        """Returns `advance` for inputs (m, N) of N environments."""
        if self.vectorized:
            return self.advance(rng, plant, task_state, u)
        moved = np.empty_like(task_state)
        with storing_nothing(self):
            for episode, (each, own) in enumerate(zip(task_state, u.T, strict=True)):
                moved[episode] = self.advance(rng, plant, each, own)
        return moved

    def predict_one(self, plant: LinearPlant, task_state: Any, u: np.ndarray) -> Any:
        """Returns `predict` of a task's state that it cannot write into."""
        return self.predict(plant, _own(task_state), u)

    def predict_many(self, plant: LinearPlant, task_state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns `predict_one` for inputs (m, N) of N environments."""
        if self.vectorized:
            return self.predict_one(plant, task_state, u)
        predicted = np.empty_like(task_state)
        for episode, (each, own) in enumerate(zip(task_state, u.T, strict=True)):
            predicted[episode] = self.predict_one(plant, each, own)
        return predicted

    def observe_many(self, task_state: np.ndarray) -> np.ndarray:
        """Returns the extra observation entries of N environments, shape (extra, N)."""
        if self.vectorized:
            return self.observe(task_state)
        return np.array([self.observe(each) for each in task_state], dtype=np.float64).T

    def reward_one(self, plant: LinearPlant, task_state: Any, state: np.ndarray, u: np.ndarray) -> float:
        """Returns `reward` of a read-only state; raises ValueError if it is no number (infinity is one)."""
        value = self.reward(plant, task_state, state, u)
        try:
            reward = nan if getattr(value, "ndim", 0) else float(value + 0.0)
        except (TypeError, ValueError):
            reward = nan
        if reward != reward:
            raise ValueError(f"the reward of {type(self).__name__} must be a number, got {shown(value)}")
        return reward

    def reward_many(self, plant: LinearPlant, task_state: np.ndarray, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns `reward_one` for states (n, N) and inputs (m, N), shape (N,)."""
        if not self.vectorized:
            each = zip(task_state, state.T, u.T, strict=True)
            with storing_nothing(self):
                return np.array([self.reward_one(plant, own, x, applied) for own, x, applied in each])
        rewards = np.array(self.reward(plant, task_state, state, u))
        if rewards.shape != u.shape[1:] or rewards.dtype.kind not in "fiu" or np.isnan(rewards).any():
            raise ValueError(
                f"the reward of {type(self).__name__} must be a number for each environment, shape {u.shape[1:]}, got "
                f"{shown(rewards)} of shape {rewards.shape}"
            )
        return rewards.astype(np.float64, copy=False)

    def check(self, plant: LinearPlant) -> str:
        """Returns why this task does not suit the plant, or an empty string."""
        return ""


def _own(task_state: Any) -> Any:
    """Returns a task's state for code of others: a read-only array, or a copy of anything else."""
    return guarded(task_state) if isinstance(task_state, np.ndarray) else deepcopy(task_state)


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
                self._set(**{name: as_covariance(value, None, name)})

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
        self._set(output=as_vector(output, None, "output"))
        self._check(as_number, "reach", "width", low=0.0, low_open=True)
        self._check(as_number, "change_probability", low=0.0, high=1.0)
        self._check(as_count, "preview", low=0, high=1000)
        self._check(as_number, "change_price", low=0.0)

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
        self._check(as_number, "fastest", low=0.0, low_open=True)
        self._check(as_number, "change_probability", low=0.0, high=1.0)
        self._check(as_number, "error_weight", "input_weight", low=0.0)
        self._check(as_count, "input_index", low=0)

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


# Settings of these are JSON values.
TASKS = (Regulation, SpeedTracking, SetpointTracking)
