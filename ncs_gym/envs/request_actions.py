"""Communication as an action: wrappers whose actions have one entry more, which asks for a sample."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorWrapper
from gymnasium.vector.utils import batch_space

from ncs_gym.envs.env import NCSEnv
from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.validation import AroundEnvironments, as_number, as_numbers, require_batched_infos, shown


class _WithCost:
    """Mixin of what subtracts the cost of packets."""

    _cost: float

    @property
    def cost(self) -> float:
        """Of a packet, in units of the reward; it may be changed while an agent is trained."""
        return self._cost

    @cost.setter
    def cost(self, value: float) -> None:
        self._cost = as_number(value, "cost", low=0.0)
        self._saved_kwargs, self._cached_spec = {"cost": self._cost}, None


class RequestActions(_WithCost, gym.Wrapper, RecordConstructorArgs):
    """Lets an agent decide when samples are taken, at a price (docs/requests.md).

    The action has one entry more, in [-1, 1]: a sample is asked for where it is positive. The observation has two
    entries more: the age of the newest sample used, and how many samples are requested that are newer than it
    (`NCSEnv.outstanding`) [steps, samples], both clipped to what the contract allows. From the reward the cost of every
    packet sent is subtracted, also of those that the contract forces. Wrap it around the shield.

    Args:
        env: An `NCSEnv` whose channel takes samples on request, possibly wrapped; actions and observations are vectors
            of numbers.
        cost: Of a packet, in units of the reward, >= 0.

    Raises:
        ValueError: If the environment is another one, or the cost is negative.
    """

    def __init__(self, env: gym.Env, cost: float = 0.0) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self.cost = cost
        self._inner = _on_request(env, NCSEnv)
        self._most = self._inner.request_limits
        self.action_space = _with_request(env.action_space)
        self.observation_space = _with_age(env.observation_space, self._most)
        self._packets = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode; see `NCSEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._packets = 0
        return self._seen(observation), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Asks for a sample if the last entry of the action is positive, and applies the others."""
        inputs, asked = _parted(action, self.action_space)
        self._inner.request(bool(asked))
        observation, reward, terminated, truncated, info = self.env.step(inputs)
        sent, self._packets = info["packets"] - self._packets, info["packets"]
        reward = np.asarray(reward, np.float64).item() - self.cost * sent
        return self._seen(observation), reward, terminated, truncated, info

    def _seen(self, observation: np.ndarray) -> np.ndarray:
        more = np.minimum(self._inner.request_state, self._most)
        return np.concatenate([observation, more]).astype(self.observation_space.dtype)


class VectorRequestActions(_WithCost, AroundEnvironments, VectorWrapper, RecordConstructorArgs):
    """`RequestActions` for an `NCSVectorEnv`, possibly behind a shield.

    Args:
        env: An `NCSVectorEnv` whose channel takes samples on request, possibly wrapped; not with SAME_STEP autoreset.
        cost: See `RequestActions`.

    Raises:
        ValueError: If the environment is another one, or the cost is negative.
    """

    def __init__(self, env: Any, cost: float = 0.0) -> None:
        RecordConstructorArgs.__init__(self)
        VectorWrapper.__init__(self, env)
        self.cost = cost
        self._inner = _on_request(env, NCSVectorEnv)
        if self._inner.autoreset_mode is AutoresetMode.SAME_STEP:
            raise ValueError("with SAME_STEP autoreset the age at an episode's end is not known: use NEXT_STEP")
        self._most = self._inner.single.request_limits
        self.single_action_space = _with_request(env.single_action_space)
        self.single_observation_space = _with_age(env.single_observation_space, self._most)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._packets = np.zeros(self.num_envs, np.int64)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts episodes; see `NCSVectorEnv.reset`."""
        # gymnasium's annotation leaves out the lists that its own vector environments take.
        observations, info = self.env.reset(seed=seed, options=options)  # pyright: ignore[reportArgumentType]
        require_batched_infos(info, "VectorRequestActions")
        self._packets = info["packets"].copy()
        return self._seen(observations), info

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Asks for samples where the last entries of the actions, (N, m+1), are positive, and applies the others."""
        inputs, asked = _parted(actions, self.action_space)
        self._inner.request(asked)
        observations, rewards, terminated, truncated, info = self.env.step(inputs)
        sent = np.maximum(info["packets"] - self._packets, 0)  # nothing in a step that only begins an episode
        self._packets = info["packets"].copy()
        return self._seen(observations), rewards - self.cost * sent, terminated, truncated, info

    def _seen(self, observations: np.ndarray) -> np.ndarray:
        more = np.minimum(np.stack([self._inner.belief.age, self._inner.outstanding], axis=1), self._most)
        return np.concatenate([observations, more], axis=1).astype(self.observation_space.dtype)


def _on_request(env: Any, kind: type) -> Any:
    """Returns the environment inside all wrappers, which takes requests."""
    inner = env.unwrapped
    if not isinstance(inner, kind):
        raise ValueError(f"expected an {kind.__name__} inside, got {type(inner).__name__}")
    inner.request(False)  # raises where samples are sent by themselves
    return inner


def _with_request(actions: Any) -> Any:
    """Returns actions with one entry more, which asks for a sample."""
    if not (isinstance(actions, Box) and len(actions.shape) == 1):
        raise ValueError(f"a request is one entry more of a vector of numbers, got {actions}")
    return _wider(actions, [-1.0], [1.0])


def _wider(space: Any, low: Any, high: Any) -> Box:
    """Returns a space of vectors with more entries, of floats that hold the others'."""
    kind = np.result_type(space.dtype, np.float32)
    least, most = (np.concatenate(pair).astype(kind) for pair in ((space.low, low), (space.high, high)))
    return Box(least, most, dtype=kind.type)


def _with_age(observations: Any, most: np.ndarray) -> Box:
    """Returns the space of observations with the age of the newest sample and the requests after it."""
    if not (isinstance(observations, Box) and len(observations.shape) == 1):
        raise ValueError(
            f"the age of the newest sample is an entry more of a vector of numbers, got {observations}: put "
            "FlattenObservation inside"
        )
    return _wider(observations, np.zeros(2), most)


def _parted(actions: Any, space: Any) -> tuple[Any, np.ndarray]:
    """Returns what actions are without a request, and whether a sample is asked for."""
    numbers = as_numbers(actions)
    if numbers is None or numbers.shape != space.shape or not np.isfinite(numbers).all():
        raise ValueError(f"actions must be finite with shape {space.shape}, got {shown(actions)}")
    given, asked = np.asarray(actions), np.asarray(numbers[..., -1] > 0.0)
    return given[..., :-1].copy(), asked
