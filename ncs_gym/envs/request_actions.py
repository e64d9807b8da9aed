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
from ncs_gym.network.channel import largest_age
from ncs_gym.validation import AroundEnvironments, as_number, as_numbers, require_batched_infos, shown


class _Requesting(RecordConstructorArgs):
    """What both wrappers have in common."""

    env: Any
    action_space: Any
    observation_space: Any
    _inner: Any
    _wrapper: Any
    _kind: type

    def __init__(self, env: Any, cost: float = 0.0) -> None:
        RecordConstructorArgs.__init__(self)
        self._wrapper.__init__(self, env)
        self.cost, self._inner = cost, env.unwrapped
        if not isinstance(self._inner, self._kind):
            raise ValueError(f"expected an {self._kind.__name__} inside, got {type(self._inner).__name__}")
        self._inner.request(False)  # raises where samples are sent by themselves
        contract, input_delay = self._inner.contract, self._inner.downlink_protocol.input_delay
        oldest = largest_age(contract, self._inner.horizon)
        newer = oldest if contract else self._inner.channel.longest_delay
        # Up to where age and number of the samples requested are told apart [steps, samples].
        self._limits = np.array([oldest, newer + input_delay], dtype=np.float64).clip(min=1.0)

    @property
    def cost(self) -> float:
        """Of a packet, in units of the reward; it may be changed while an agent is trained."""
        return self._cost

    @cost.setter
    def cost(self, value: float) -> None:
        self._cost = as_number(value, "cost", low=0.0)
        self._saved_kwargs, self._cached_spec = {"cost": self._cost}, None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts episodes; see the environment's."""
        observation, info = self.env.reset(seed=seed, options=options)
        require_batched_infos(info, type(self).__name__)
        self._packets = np.copy(info["packets"])
        return self._seen(observation, info), info

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Asks for a sample where the last entry of the action is positive, and applies the others.

        Raises:
            ValueError: If the action is not finite or wrongly shaped; nothing has moved then.
        """
        numbers = as_numbers(action)
        if numbers is None or numbers.shape != self.action_space.shape or not np.isfinite(numbers).all():
            raise ValueError(f"actions must be finite with shape {self.action_space.shape}, got {shown(action)}")
        self._inner.request(np.asarray(numbers[..., -1] > 0.0))
        observation, reward, *ends, info = self.env.step(np.asarray(action)[..., :-1].copy())
        sent = np.maximum(info["packets"] - self._packets, 0)  # nothing in a step that only begins an episode
        self._packets = np.copy(info["packets"])
        return self._seen(observation, info), reward - self.cost * sent, ends[0], ends[1], info

    def _seen(self, observation: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        more = np.stack([info["measurement_age"], self._inner.outstanding], axis=-1)
        entries = np.concatenate([observation, np.minimum(more, self._limits)], axis=-1)
        return entries.astype(self.observation_space.dtype)


class RequestActions(_Requesting, gym.Wrapper):
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

    _kind, _wrapper = NCSEnv, gym.Wrapper

    def __init__(self, env: gym.Env, cost: float = 0.0) -> None:
        super().__init__(env, cost)
        self.action_space = _wider(env.action_space, [-1.0], [1.0])
        self.observation_space = _wider(env.observation_space, np.zeros(2), self._limits)


class VectorRequestActions(_Requesting, AroundEnvironments, VectorWrapper):
    """`RequestActions` for an `NCSVectorEnv`, possibly behind a shield.

    Args:
        env: An `NCSVectorEnv` whose channel takes samples on request, possibly wrapped; not with SAME_STEP autoreset.
        cost: See `RequestActions`.

    Raises:
        ValueError: If the environment is another one, or the cost is negative.
    """

    _kind, _wrapper = NCSVectorEnv, VectorWrapper

    def __init__(self, env: Any, cost: float = 0.0) -> None:
        super().__init__(env, cost)
        if self._inner.autoreset_mode is AutoresetMode.SAME_STEP:
            raise ValueError("with SAME_STEP autoreset the age at an episode's end is not known: use NEXT_STEP")
        self.single_action_space = _wider(env.single_action_space, [-1.0], [1.0])
        self.single_observation_space = _wider(env.single_observation_space, np.zeros(2), self._limits)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)


def _wider(space: Any, low: Any, high: Any) -> Box:
    """Returns a space of vectors with more entries, of floats that hold the others'."""
    if not (isinstance(space, Box) and len(space.shape) == 1):
        raise ValueError(f"requests are entries more of vectors of numbers, got {space}: put FlattenObservation inside")
    kind = np.result_type(space.dtype, np.float32)
    least, most = (np.concatenate(pair).astype(kind) for pair in ((space.low, low), (space.high, high)))
    return Box(least, most, dtype=kind.type)
