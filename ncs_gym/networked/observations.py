"""What travels of an observation, and what an agent sees of it: parts, their spaces, and the entries that are added."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from ncs_gym.network.channel import LONGEST_DELAY, TraceChannel
from ncs_gym.validation import shown

# Ages beyond this are observed as this [steps].
OLDEST_OBSERVED = LONGEST_DELAY
# What `observe` may name.
ENTRIES = "age", "arrived", "pending_actions"


class Part(NamedTuple):
    """A part of an observation with a channel of its own: key in a `Dict` or `Tuple`, None for the whole, and space."""

    key: Any
    space: spaces.Space

    def of(self, observation: Any) -> Any:
        """Returns this part of an observation."""
        return observation if self.key is None else observation[self.key]


def parts_of(space: spaces.Space, channel: Any) -> tuple[list[Part], list[Any]]:
    """Returns the parts of observations that travel alone, and the channel or channels to draw from of each.

    `channel` is what `Networked` was given: one for all, or one for each key of a `Dict` or entry of a `Tuple`; keys
    that are left out arrive at once.

    Raises:
        ValueError: If there are channels of keys that the space does not have.
    """
    if isinstance(channel, Mapping) and not channel.keys() <= TraceChannel.__dataclass_fields__.keys() | {"type"}:
        keys = list(space.spaces) if isinstance(space, spaces.Dict) else []
        if unknown := [key for key in channel if key not in keys]:
            known = f"its keys are {', '.join(map(str, keys))}" if keys else f"the space is {shown(space)}"
            raise ValueError(
                f"channel has the key {shown(unknown[0])}, which neither channels nor observations have: {known}"
            )
        return [Part(key, space[key]) for key in keys], [channel.get(key) for key in keys]  # type: ignore[index]
    if isinstance(space, spaces.Tuple) and isinstance(channel, tuple | list):
        if len(channel) != len(space.spaces):
            raise ValueError(f"observations have {len(space.spaces)} entries, channel has {len(channel)}")
        return [Part(index, each) for index, each in enumerate(space.spaces)], list(channel)
    return [Part(None, space)], [channel]


def joined(parts: Sequence[Part], seen: Sequence[Any]) -> Any:
    """Returns the observation whose parts are given."""
    if parts[0].key is None:
        return seen[0]
    if isinstance(parts[0].key, int):
        return tuple(seen)
    return {part.key: each for part, each in zip(parts, seen, strict=True)}


def quantized(channel: Any, space: spaces.Space, sample: Any) -> Any:
    """Returns a sample with its entries of floats rounded as a channel does, within their limits; others as they are.

    Of N environments, whose channel is stacked, samples have N as the first axis.
    """
    if isinstance(space, spaces.Dict):
        return {key: quantized(channel, each, sample[key]) for key, each in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(quantized(channel, each, part) for each, part in zip(space.spaces, sample, strict=True))
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating):
        numbers = np.asarray(sample, dtype=np.float64)  # in a coarser type the number of steps would overflow
        rounded = channel.quantize(numbers.T).T  # the last axis is that of environments
        return np.asarray(np.clip(rounded, space.low, space.high), space.dtype)  # of shape () no scalar
    return sample


def has_floats(space: spaces.Space) -> bool:
    """Returns whether anything in a space can be quantized."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        inner = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        return any(map(has_floats, inner))
    return isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating)


def zero_of(space: spaces.Space) -> Any:
    """Returns the zero of a space; raises ValueError if it has none."""
    if isinstance(space, spaces.Dict):
        return {key: zero_of(each) for key, each in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(map(zero_of, space.spaces))
    zero = np.zeros(space.shape or (), space.dtype) if space.shape is not None else None
    zero = np.int64(0) if isinstance(space, spaces.Discrete) else zero
    if zero is None or not space.contains(zero):
        raise ValueError(f"{shown(space)} has no zero")
    return zero


def snapshot(sample: Any) -> Any:
    """Returns a sample or an action that stays as it is, whatever environment or agent write into their own later."""
    if isinstance(sample, np.ndarray):
        return sample.copy(order="K")
    if isinstance(sample, dict):
        return {key: snapshot(each) for key, each in sample.items()}
    if isinstance(sample, tuple):
        entries = map(snapshot, sample)
        return type(sample)(*entries) if hasattr(sample, "_fields") else tuple(entries)
    return copy.deepcopy(sample)  # lists, tensors


class Entries:
    """The entries that `observe` adds to observations, of one environment or of N.

    Args:
        names: Which ones, of "age", "arrived" and "pending_actions"; a single one also alone.
        observations: Space of the observations of one environment.
        actions: Space of its actions.
        parts: Number of parts of an observation that have a channel of their own.
        pending: How many of the last actions are pending, at least 1.

    Attributes:
        space: Space of the observations with these entries.

    Raises:
        ValueError: If a name is unknown, or a space is not of a kind that can be observed.
    """

    def __init__(
        self, names: str | Sequence[str], observations: spaces.Space, actions: spaces.Space, parts: int, pending: int
    ) -> None:
        several: tuple[Any, ...] = tuple(names) if isinstance(names, list | tuple) else (names,)
        if any(name not in ENTRIES for name in several) or len(set(several)) < len(several):
            raise ValueError(f"observe must list, each at most once, some of {', '.join(ENTRIES)}, got {shown(names)}")
        self.names, self._inner, self._actions = several, observations, actions
        made = {
            "age": lambda: spaces.Box(0.0, OLDEST_OBSERVED, (parts,), np.float32),
            "arrived": lambda: spaces.Box(0, 1, (parts,), np.int8),
            "pending_actions": lambda: pending_space(actions, pending),
        }
        added = {name: made[name]() for name in self.names}
        self._is_flat = (
            isinstance(observations, spaces.Box)
            and len(observations.shape) == 1
            and np.issubdtype(observations.dtype, np.floating)
        )
        self.space = self._widened(added)

    def _widened(self, added: dict[str, spaces.Space]) -> spaces.Space:
        inner = self._inner
        if not added:
            return inner
        if self._is_flat:
            flat: list[Any] = [inner, *map(spaces.flatten_space, added.values())]
            low, high = (np.concatenate([getattr(each, end) for each in flat]) for end in ("low", "high"))
            return spaces.Box(low.astype(inner.dtype), high.astype(inner.dtype), dtype=inner.dtype)  # type: ignore[arg-type]
        if isinstance(inner, spaces.Tuple):
            return spaces.Tuple((*inner.spaces, *added.values()))
        if isinstance(inner, spaces.Dict):
            if taken := [name for name in added if name in inner.spaces]:
                raise ValueError(f"observations have an entry {taken[0]!r} of their own: leave it out of observe")
            return spaces.Dict({**inner.spaces, **added})
        return spaces.Dict({"observation": inner, **added})

    def added_to(self, observation: Any, age: Any, arrived: Any, pending: Any) -> Any:
        """Returns an observation with the entries.

        Args:
            observation: What is seen of the environment, of N environments a batch.
            age: Of the newest sample of each part, shape (parts,) or (N, parts) [steps].
            arrived: Whether one arrived, likewise.
            pending: The pending actions, oldest first, shape (pending, ...) or (N, pending, ...), where asked for.
        """
        if not self.names:
            return observation
        values = {
            "age": lambda: np.minimum(age, OLDEST_OBSERVED).astype(np.float32),
            "arrived": lambda: np.asarray(arrived, np.int8),
            "pending_actions": lambda: self._told(np.array(pending)),  # the network writes on into its own
        }
        added = {name: values[name]() for name in self.names}
        if self._is_flat:
            lead = np.shape(observation)[:-1]
            flat = [each.reshape(*lead, -1) for each in added.values()]
            return np.concatenate([observation, *flat], axis=-1, dtype=self.space.dtype, casting="unsafe")  # type: ignore[call-overload]
        if isinstance(self._inner, spaces.Tuple):
            return (*observation, *added.values())
        own = observation if isinstance(self._inner, spaces.Dict) else {"observation": observation}
        return {**own, **added}

    def _told(self, actions: np.ndarray) -> np.ndarray:
        """Returns pending actions as `pending_space` has them, also where they were sent beyond their limits."""
        space = self._actions
        if isinstance(space, spaces.Box):
            return np.clip(actions, space.low, space.high)
        entries = actions.reshape(*actions.shape[: actions.ndim - len(space.shape or ())], -1)
        if isinstance(space, spaces.MultiBinary):
            return entries.astype(np.int8)
        counts = space.n if isinstance(space, spaces.Discrete) else space.nvec  # type: ignore[union-attr]
        numbers = entries - np.ravel(space.start)  # type: ignore[union-attr]
        one_hot = [np.arange(n) == numbers[..., k, None] for k, n in enumerate(np.ravel(counts).tolist())]
        return np.concatenate(one_hot, axis=-1, dtype=np.int8)


def pending_space(actions: spaces.Space, pending: int) -> spaces.Box:
    """Returns the space of so many actions, the first axis; those that are no numbers as vectors of zeros and ones."""
    if isinstance(actions, spaces.Box):
        low, high = (np.broadcast_to(end, (pending, *actions.shape)) for end in (actions.low, actions.high))
        return spaces.Box(low, high, dtype=actions.dtype)  # type: ignore[arg-type]
    if isinstance(actions, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return spaces.Box(0, 1, (pending, spaces.flatdim(actions)), np.int8)
    raise ValueError(f"pending_actions are for actions that are one array, got {shown(actions)}")
