"""What the benchmark changes of what is known: agents see the disturbance or what happened, shields no age."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from experiments.baselines.observer import DisturbanceObserver
from experiments.baselines.tuned import tuned_weights
from ncs_gym.validation import AroundEnvironments
from shields import Certificate, VectorSafetyShield


@dataclass(frozen=True)
class Shown:
    """Shows agents the disturbance that `lqr:observer` estimates, in parts of its largest value.

    Attributes:
        env: Id of the environment, for which the observer was tuned.
    """

    env: str

    def __call__(self, envs: VectorEnv) -> VectorEnv:
        """Returns the environments with the estimated disturbance after their observations."""
        return WithDisturbance(envs, tuned_weights(self.env, "lqr:observer").disturbance)


@dataclass(frozen=True)
class Remembered:
    """Shows agents the last estimates and the inputs that were applied between them.

    Attributes:
        steps: So many of each.
    """

    steps: int = 8

    def __call__(self, envs: VectorEnv) -> VectorEnv:
        """Returns the environments with the last estimates and actions after their observations."""
        return WithMemory(envs, self.steps)


@dataclass(frozen=True)
class OneErrorSet:
    """A shield that takes every estimation error for one of any age: what passes is safe for all of them.

    In the rows of a polytope that is the smallest set that holds the error sets of all ages.

    Attributes:
        certificate: Of a polytope and a contract, which the network keeps.
    """

    certificate: Certificate

    def __call__(self, envs: VectorEnv) -> VectorSafetyShield:
        """Returns the environments behind the shield."""
        shield = VectorSafetyShield(envs, self.certificate, on_unproved="ignore")
        by_age = shield.filter.errors_of_many(self.certificate.error_shapes)
        worst = {name: np.max for name in ("half_widths", "own")}
        one = by_age._make(
            worst.get(name, np.min)(each, axis=-1, keepdims=True) for name, each in by_age._asdict().items()
        )
        vars(shield.filter)["errors_of_many"] = lambda shapes: one.of(np.zeros(len(shapes), np.intp))
        return shield


class WithMore(AroundEnvironments, VectorWrapper, ABC):
    """Observations with more entries behind them.

    Args:
        env: A vector environment of this package.
        low: Smallest values, shape (more,).
        high: Largest values, shape (more,).
    """

    def __init__(self, env: VectorEnv, low: np.ndarray, high: np.ndarray) -> None:
        super().__init__(env)
        space: Any = env.single_observation_space
        low, high = np.concatenate([space.low, low]), np.concatenate([space.high, high])
        self.single_observation_space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32))
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    @abstractmethod
    def more(self, observations: np.ndarray, infos: dict[str, Any], fresh: np.ndarray) -> np.ndarray:
        """Returns the entries, shape (N, more); loops that are not fresh have not moved since the last call."""

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins episodes, all or those in a mask."""
        observations, infos = self.env.reset(seed=seed, options=options)
        fresh = (options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_))
        return self._with_more(observations, infos, fresh), infos

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps the environments."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        fresh = np.ones(self.num_envs, np.bool_)
        return self._with_more(observations, infos, fresh), rewards, terminated, truncated, infos

    def _with_more(self, observations: np.ndarray, infos: dict[str, Any], fresh: np.ndarray) -> np.ndarray:
        more = self.more(observations, infos, fresh)
        return np.concatenate([observations, more], axis=1, dtype=np.float32)


class WithDisturbance(WithMore):
    """Observations with the disturbance that persists, see `DisturbanceObserver`.

    Args:
        env: A vector environment of this package.
        alpha: Of the observer.
    """

    def __init__(self, env: VectorEnv, alpha: float) -> None:
        inner: Any = env.unwrapped
        self._observer = DisturbanceObserver(inner.single, alpha)
        one = np.ones(inner.single.plant.n)
        super().__init__(env, -one, one)

    def more(self, observations: np.ndarray, infos: dict[str, Any], fresh: np.ndarray) -> np.ndarray:
        """Returns d_hat in parts of its largest value; one that is always 0 stays 0."""
        disturbances, largest = self._observer.see(infos, fresh)[1], self._observer.largest
        return np.divide(disturbances, largest, out=np.zeros_like(disturbances), where=largest > 0.0)


class WithMemory(WithMore):
    """Observations with those of the estimate in the last steps, and the actions that were applied between them.

    Before an episode the estimate was the first one, and the action 0.

    Args:
        env: A vector environment of this package, whose observations begin with the estimate.
        steps: So many steps.
    """

    def __init__(self, env: VectorEnv, steps: int) -> None:
        inner: Any = env.unwrapped
        space, self._n = inner.single_observation_space, inner.single.plant.n
        one = np.ones(inner.single.plant.m)
        low, high = np.append(space.low[: self._n], -one), np.append(space.high[: self._n], one)
        self._past = np.zeros((env.num_envs, steps, len(low)))
        self._now = np.zeros((env.num_envs, self._n))
        super().__init__(env, np.tile(low, steps), np.tile(high, steps))

    def more(self, observations: np.ndarray, infos: dict[str, Any], fresh: np.ndarray) -> np.ndarray:
        """Returns estimates and actions, the oldest first."""
        estimates, begun = observations[:, : self._n], fresh & (infos["episode_steps"] == 0)
        moved = fresh & ~begun
        last = np.concatenate([self._now, infos["action_applied"]], axis=1)
        self._past[moved] = np.concatenate([self._past[:, 1:], last[:, None]], axis=1)[moved]
        self._past[begun] = np.pad(estimates, ((0, 0), (0, self._past.shape[2] - self._n)))[begun][:, None]
        self._now[fresh] = estimates[fresh]
        return self._past.reshape(len(self._past), -1)
