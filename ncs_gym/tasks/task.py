"""What the agent is paid for, and the extra states that belong to it.

`begin` draws the task's memory for an episode, `advance` moves it one step; neither stores anything in
the settings, so one object serves any number of environments.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import FrozenArrays, as_count, as_covariance, as_number, as_vector, forget_batches

BATCHES = {name: f"{name}_many" for name in ("begin", "advance", "observe", "reward")}


@cache
def _compiled(name: str) -> Any:
    """Returns a module of compiled loops, at first use: the compiler takes half a second to import."""
    return import_module(f"ncs_gym.{name}")


class Task(FrozenArrays, ABC):
    """A reward, and perfectly known extra entries of the observation.

    The methods that end in `_many` serve vector environments. A subclass that overrides others without these gets the
    ones below, which go through the environments one by one.
    """

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Keeps batch methods of a parent from hiding what a subclass changes."""
        super().__init_subclass__(**keywords)
        forget_batches(cls, Task, BATCHES)

    def begin(self, rng: np.random.Generator, plant: LinearPlant) -> Any:
        """Returns the task's memory at the start of an episode (None unless overridden)."""
        return None

    def advance(self, rng: np.random.Generator, plant: LinearPlant, memory: Any, u: np.ndarray) -> Any:
        """Returns the memory after input u, shape (m,), was applied for one step."""
        return memory

    def observe(self, memory: Any) -> np.ndarray:
        """Returns the extra observation entries, shape (extra,)."""
        return np.zeros(0)

    def observation_bound(self, plant: LinearPlant, horizon: int) -> np.ndarray:
        """Returns the largest absolute value of each extra entry within `horizon` steps, shape (extra,)."""
        return np.zeros(0)

    @abstractmethod
    def reward(self, plant: LinearPlant, memory: Any, state: np.ndarray, u: np.ndarray) -> float:
        """Returns the reward of a step that applied u (m,) and ended in `state` (n,) and `memory`."""

    def begin_many(self, rng: np.random.Generator, plant: LinearPlant, count: int) -> np.ndarray:
        """Returns the memories of `count` episodes along the first axis."""
        memories = np.empty(count, dtype=object)
        memories[:] = [self.begin(rng, plant) for _ in range(count)]
        return memories

    def advance_many(
        self, rng: np.random.Generator, plant: LinearPlant, memory: np.ndarray, inputs: np.ndarray
    ) -> np.ndarray:
        """Returns what `advance` does for inputs (N, m) of many environments; one by one unless overridden."""
        moved = np.empty_like(memory)
        moved[:] = [self.advance(rng, plant, each, u) for each, u in zip(memory, inputs, strict=True)]
        return moved

    def observe_many(self, memory: np.ndarray) -> np.ndarray:
        """Returns the extra observation entries of many environments, shape (N, extra)."""
        return np.array([self.observe(each) for each in memory])

    def reward_many(self, plant: LinearPlant, memory: np.ndarray, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Returns the rewards of many environments, shape (N,), for states (N, n) and inputs (N, m)."""
        several = zip(memory, states, inputs, strict=True)
        return np.array([self.reward(plant, each, state, u) for each, state, u in several], dtype=np.float64)

    def check(self, plant: LinearPlant) -> str:
        """Returns why this task does not suit the plant, or an empty string."""
        return ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Regulation(Task):
    """Keep the state near zero: reward -(x'Qx + u'Ru) with the true next state x and the input applied.

    Attributes:
        state_cost: Q, shape (n, n); None: C'C, so that the edge of the safe box costs about 1.
        input_cost: R, shape (m, m); None: 0.01 diag(1 / u_max^2).

    Raises:
        ValueError: If a cost is not symmetric positive semidefinite.
    """

    state_cost: np.ndarray | None = None
    input_cost: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("state_cost", "input_cost"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, as_covariance(value, None, name))
        self._freeze_arrays()

    def costs(self, plant: LinearPlant) -> tuple[np.ndarray, np.ndarray]:
        """Returns Q and R for a plant."""
        return _costs(self, plant)

    def reward(self, plant, memory, state, u):  # noqa: D102
        Q, R = self.costs(plant)
        return -float(state @ Q @ state) - float(u @ R @ u)

    def begin_many(self, rng, plant, count):  # noqa: D102
        return np.zeros((count, 0))

    def advance_many(self, rng, plant, memory, inputs):  # noqa: D102
        return memory

    def observe_many(self, memory):  # noqa: D102
        return memory

    def reward_many(self, plant, memory, states, inputs):  # noqa: D102
        Q, R = self.costs(plant)
        return -np.einsum("ei,ij,ej->e", states, Q, states) - np.einsum("ei,ij,ej->e", inputs, R, inputs)

    def check(self, plant):  # noqa: D102
        for name, size in (("state_cost", plant.n), ("input_cost", plant.m)):
            value = getattr(self, name)
            if value is not None and value.shape != (size, size):
                return f"{name} must have shape ({size}, {size}), got {value.shape}"
        return ""


@lru_cache(maxsize=64)
def _costs(task: Regulation, plant: LinearPlant) -> tuple[np.ndarray, np.ndarray]:
    """Returns Q and R."""
    Q = plant.C.T @ plant.C if task.state_cost is None else task.state_cost
    R = np.diag(0.01 / plant.u_max**2) if task.input_cost is None else task.input_cost
    return Q, R


class SpeedProfile(NamedTuple):
    """Memory of `SpeedTracking`: the vehicle's speed and the speed it should have [m/s]."""

    speed: float
    target: float


@dataclass(frozen=True, eq=False, kw_only=True)
class SpeedTracking(Task):
    """Follow a random piecewise-constant speed profile with a vehicle whose acceleration is an input.

    The speed moves by v+ = v + dt u. The observation gains the speed error, target - v [m/s]. The reward is
    -error_weight min(|error| / 5, 5) - input_weight u^2, at the end of the step.

    Attributes:
        fastest: Targets (and the first speed) are uniform in `[0, fastest]` [m/s].
        change_probability: Per step, to draw a new target.
        error_weight: Per 5 m/s of error.
        input_weight: Per (m/s^2)^2.
        input_index: Which input is the acceleration [m/s^2].

    Raises:
        ValueError: If a value is out of range.
    """

    fastest: float = 25.0
    change_probability: float = 0.02
    error_weight: float = 0.2
    input_weight: float = 0.002
    input_index: int = 0

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

    def begin(self, rng, plant):  # noqa: D102
        return SpeedProfile(rng.uniform(0.0, self.fastest), rng.uniform(0.0, self.fastest))

    def advance(self, rng, plant, memory, u):  # noqa: D102
        speed = memory.speed + plant.dt * float(u[self.input_index])
        changes, target = rng.random() < self.change_probability, rng.uniform(0.0, self.fastest)
        return SpeedProfile(speed, target if changes else memory.target)

    def observe(self, memory):  # noqa: D102
        return np.array([memory.target - memory.speed])

    def observation_bound(self, plant, horizon):  # noqa: D102
        return np.array([self.fastest + horizon * plant.dt * plant.u_max[self.input_index]])

    def reward(self, plant, memory, state, u):  # noqa: D102
        error = memory.target - memory.speed
        effort = float(u[self.input_index])
        return -self.error_weight * min(abs(error) / 5.0, 5.0) - self.input_weight * effort**2

    def begin_many(self, rng, plant, count):  # noqa: D102
        return self.fastest * rng.random((2, count)).T

    def advance_many(self, rng, plant, memory, inputs):  # noqa: D102
        moved, draws = np.empty_like(memory), _compiled("draws").uniform_many(rng, 2, len(memory))
        effort, chance = inputs[:, self.input_index], self.change_probability
        _compiled("profile").follow_profile(memory, effort, plant.dt, draws, chance, self.fastest, moved)
        return moved

    def observe_many(self, memory):  # noqa: D102
        return memory[:, 1:] - memory[:, :1]

    def reward_many(self, plant, memory, states, inputs):  # noqa: D102
        rewards, effort = np.empty(len(memory)), inputs[:, self.input_index]
        _compiled("profile").profile_reward(memory, effort, self.error_weight, self.input_weight, rewards)
        return rewards

    def check(self, plant):  # noqa: D102
        if self.input_index >= plant.m:
            return f"input_index must be < {plant.m}, got {self.input_index}"
        return ""


@dataclass(frozen=True, eq=False, kw_only=True)
class SetpointTracking(Task):
    """Bring one output c x to a random piecewise-constant target.

    The observation gains the target. The reward is 1 - min(|c x - target| / width, 1) at the end of the step, so that
    every step survived pays.

    Attributes:
        output: c, shape (n,).
        reach: Targets are uniform in [-reach, reach], in the unit of c x.
        width: The error that pays nothing, in the unit of c x.
        change_probability: Per step, to draw a new target.

    Raises:
        ValueError: If a value is out of range.
    """

    output: np.ndarray
    reach: float
    width: float
    change_probability: float = 0.02

    def __post_init__(self) -> None:
        output = [self.output] if isinstance(self.output, int | float) else self.output
        object.__setattr__(self, "output", as_vector(output, None, "output"))
        for name in ("reach", "width"):
            object.__setattr__(self, name, as_number(getattr(self, name), name, low=0.0, low_open=True))
        probability = as_number(self.change_probability, "change_probability", low=0.0, high=1.0)
        object.__setattr__(self, "change_probability", probability)
        self._freeze_arrays()

    def begin(self, rng, plant):  # noqa: D102
        return rng.uniform(-self.reach, self.reach)

    def advance(self, rng, plant, memory, u):  # noqa: D102
        changes, target = rng.random() < self.change_probability, rng.uniform(-self.reach, self.reach)
        return target if changes else memory

    def observe(self, memory):  # noqa: D102
        return np.array([memory])

    def observation_bound(self, plant, horizon):  # noqa: D102
        return np.array([self.reach])

    def reward(self, plant, memory, state, u):  # noqa: D102
        return 1.0 - min(abs(float(self.output @ state) - memory) / self.width, 1.0)

    def begin_many(self, rng, plant, count):  # noqa: D102
        return self.reach * (2.0 * rng.random((count, 1)) - 1.0)

    def advance_many(self, rng, plant, memory, inputs):  # noqa: D102
        moved, draws = np.empty_like(memory), _compiled("draws").uniform_many(rng, 2, len(memory))
        _compiled("profile").follow_targets(memory, draws, self.change_probability, self.reach, moved)
        return moved

    def observe_many(self, memory):  # noqa: D102
        return memory

    def reward_many(self, plant, memory, states, inputs):  # noqa: D102
        rewards = np.empty(len(memory))
        _compiled("profile").target_reward(memory, states, self.output, self.width, rewards)
        return rewards

    def check(self, plant):  # noqa: D102
        if self.output.shape != (plant.n,):
            return f"output must have shape ({plant.n},), got {self.output.shape}"
        return ""
