"""Another Gymnasium environment as the process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TimeLimit

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.process import Process
from ncs_gym.validation import as_setting, shown

# What is read back may differ from what was written by this many half-widths: an environment may keep float32.
READ_BACK = 1e-6
# Seeds of inner episodes are below this.
SEEDS = 2**31


@dataclass(frozen=True)
class GymProcess(Process):
    """Steps another Gymnasium environment whose action space is a `Box` and whose state can be read.

    | event | what happens inside |
    |---|---|
    | reset | `reset(seed=...)` with a seed drawn from `np_random`; then `write_state` with the start, if there is one |
    | start | drawn by `write_state` from `initial_set` or the option "state"; without it wherever the reset left it |
    | step | one `step` with the input as an action; reward and observation are not used |
    | disturbance | `write_state` with the next state plus d; without it none is added |
    | termination, truncation | those of the control loop in that step; a `TimeLimit` inside is taken off |

    In vectors one inner environment per episode is stepped in a loop.

    Attributes:
        make: Returns a fresh environment; called once for each environment.
        read_state: Returns x, shape (n,), in the plant's coordinates, given the environment that `make` returned.
        write_state: Puts the environment into a state x, shape (n,); None if that cannot be done.
        write_action: Returns the action for an input u, shape (m,) [physical units]; by default u itself in the dtype
            and the shape of the action space.

    Raises:
        ValueError: If one of them cannot be called.
    """

    make: Callable[[], gym.Env]
    read_state: Callable[[Any], Any]
    write_state: Callable[[Any, np.ndarray], Any] | None = None
    write_action: Callable[[np.ndarray], Any] | None = None

    def __post_init__(self) -> None:
        for name in ("make", "read_state", "write_state", "write_action"):
            value = getattr(self, name)
            if not callable(value) and (value is not None or name in ("make", "read_state")):
                raise ValueError(f"GymProcess: {name} must be a function, got {shown(value)}")

    def opened(self, plant: LinearPlant, size: int | None) -> Process:
        """Returns the opened environments; raises ValueError if they do not fit, or `make` returns one again."""
        if size is None:
            return OpenedEnv(self, plant)
        inner = [OpenedEnv(self, plant) for _ in range(size)]
        if len({id(each.env.unwrapped) for each in inner}) < size:
            raise ValueError("GymProcess: make must return a fresh environment at every call")
        return _OpenedEnvs(inner)


class OpenedEnv(Process):
    """One inner environment at run time; raises ValueError if it is none, or its action space does not fit."""

    def __init__(self, process: GymProcess, plant: LinearPlant) -> None:
        self._read, self._write, self._write_action = process.read_state, process.write_state, process.write_action
        self._half_widths, self._n = plant.half_widths, plant.n
        self.is_written = self._write is not None
        env = process.make()
        if not isinstance(env, gym.Env):
            raise ValueError(f"GymProcess: make must return a gymnasium.Env, got {shown(env)}")
        self.env: gym.Env = _without_time_limits(env)
        self._has_started = False
        try:
            self._dtype, self._shape = self._action_form(env.action_space, plant)
        except ValueError:
            env.close()
            raise

    def _action_form(self, space: Any, plant: LinearPlant) -> tuple[Any, tuple[int, ...]]:
        if not isinstance(space, Box):
            raise ValueError(f"GymProcess needs an environment with a Box of actions, got {type(space).__name__}")
        if self._write_action is None:
            if space.shape is None or int(np.prod(space.shape)) != plant.m:
                raise ValueError(
                    f"the plant has {plant.m} inputs, actions have shape {space.shape}: give GymProcess write_action"
                )
            low, high = space.low.ravel(), space.high.ravel()
            room = READ_BACK * np.maximum(np.abs(low), np.abs(high))
            if ((plant.input_ends - [low, high]) * [[-1.0], [1.0]] > room).any():
                ends, actions = shown(plant.input_ends.tolist()), shown([low.tolist(), high.tolist()])
                raise ValueError(f"the input limits, {ends}, go beyond the actions, {actions}: give write_action")
        return space.dtype, space.shape

    def start(self, rng: np.random.Generator, state: np.ndarray, chosen: np.ndarray | None) -> np.ndarray:  # noqa: D102
        self.env.reset(seed=int(rng.integers(SEEDS)))
        self._has_started, self.terminated, self.truncated = True, False, False
        return self._read_state() if self._write is None else self.write(state)

    def step(self, plant: LinearPlant, state: np.ndarray, u: np.ndarray) -> np.ndarray:  # noqa: D102
        if self.terminated or self.truncated:
            raise gym.error.ResetNeeded("the process inside has ended its episode: call reset")
        write = self._write_action
        action = u.astype(self._dtype).reshape(self._shape) if write is None else write(u.copy())
        _, _, terminated, truncated, _ = self.env.step(action)
        self.terminated, self.truncated = bool(terminated), bool(truncated)
        return self._read_state()

    def write(self, state: np.ndarray) -> np.ndarray:  # noqa: D102
        if self._write is None:
            raise ValueError("the process cannot be put into a state: give GymProcess write_state")
        if not self._has_started:
            self.env.reset(seed=0)
            self._has_started = True
        self._write(self.env, state.copy())
        read = self._read_state()
        if not (np.abs(read - state) <= READ_BACK * np.maximum(self._half_widths, np.abs(state))).all():
            found, written = shown(read.tolist()), shown(state.tolist())
            raise ValueError(f"read_state gives {found} where write_state wrote {written}: they must agree")
        return read

    def close(self) -> None:  # noqa: D102
        self.env.close()

    def _read_state(self) -> np.ndarray:
        form = f"read_state must return the state, finite with shape ({self._n},)"
        try:
            value = self._read(self.env)
        except Exception as error:
            raise ValueError(f"{form}: it raised {type(error).__name__} ({error})") from error
        state = as_setting(value)
        if state is None or state.shape != (self._n,) or not np.isfinite(state).all():
            raise ValueError(f"{form}, got {shown(value)}")
        return state


def _without_time_limits(env: gym.Env) -> gym.Env:
    if isinstance(env, TimeLimit):
        return _without_time_limits(env.env)
    if isinstance(env, gym.Wrapper):
        env.env = _without_time_limits(env.env)
    return env


class _OpenedEnvs(Process):
    vectorized = True

    def __init__(self, inner: list[OpenedEnv]) -> None:
        self.inner = inner
        self.is_written = inner[0].is_written
        self.terminated, self.truncated = np.zeros((2, len(inner)), np.bool_)

    def start(self, rng: np.random.Generator, state: np.ndarray, chosen: np.ndarray | None) -> np.ndarray:
        numbers = np.arange(len(self.inner)) if chosen is None else chosen
        started = [self.inner[e].start(rng, x, None) for e, x in zip(numbers.tolist(), state.T, strict=True)]
        self.terminated[numbers] = self.truncated[numbers] = False
        return np.array(started).T

    def step(self, plant: LinearPlant, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        x_next = state.copy()  # an episode that has ended stands still until its reset
        for e in np.flatnonzero(~(self.terminated | self.truncated)).tolist():
            each = self.inner[e]
            x_next[:, e] = each.step(plant, state[:, e], u[:, e])
            self.terminated[e], self.truncated[e] = each.terminated, each.truncated
        return x_next

    def write(self, state: np.ndarray) -> np.ndarray:
        written = state.copy()
        for e in np.flatnonzero(~(self.terminated | self.truncated)).tolist():
            written[:, e] = self.inner[e].write(state[:, e])
        return written

    def close(self) -> None:
        for each in self.inner:
            each.close()
