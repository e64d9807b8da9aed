"""What an agent is rewarded for, and the extra states that belong to it: the base class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import deepcopy
from math import nan
from typing import Any, ClassVar

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.shared import begun_many, storing_nothing
from ncs_gym.validation import ReadOnlyArrays, guarded, shown


class Task(ReadOnlyArrays, ABC):
    """A reward, and perfectly known extra entries of the observation.

    `begin` draws the task's state for an episode, `advance` moves it one step; neither stores anything in the object,
    which any number of environments share.

    Attributes:
        vectorized: Whether the methods also take arrays whose last axis is the environment, `begin` with a `size`; a
            subclass does not inherit it.
    """

    vectorized: ClassVar[bool] = False

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Takes a promise about methods from a subclass, which may override these."""
        super().__init_subclass__(**keywords)
        cls.vectorized = vars(cls).get("vectorized", False)

    def begin(self, rng: np.random.Generator, plant: LinearPlant, size: int | None = None) -> Any:
        """Returns the task's state at the start of an episode; last axis `size` if vectorized. Empty by default."""
        return np.zeros((0,) if size is None else (0, size))

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

    def begin_many(self, rng: np.random.Generator, plant: LinearPlant, count: int) -> np.ndarray:
        """Returns the task states of `count` episodes along the last axis."""
        return begun_many(self, rng, plant, count)

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
