"""What `Networked` and `VectorNetworked` are made with, checked once for both, and what an agent sees."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs, seeding
from gymnasium.wrappers import Autoreset

from ncs_gym.envs.episode_channels import EpisodeChannels
from ncs_gym.envs.json_settings import from_json, to_json
from ncs_gym.network.channel import LONGEST_DELAY, Channel, TraceChannel, contract_of, largest_age
from ncs_gym.network.downlink import downlink_protocol
from ncs_gym.validation import as_count, as_numbers, counted, setting, shown, warn_caller

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


# Types of which nobody can change a value.
_UNCHANGING = {int, float, bool, str, type(None), np.int64, np.float64, np.float32, np.bool_}


def snapshot(sample: Any) -> Any:
    """Returns a sample or an action that stays as it is, whatever environment or agent write into their own later."""
    if type(sample) in _UNCHANGING:
        return sample
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
        # Of a one-hot vector, which number of an action each entry is about, and the choice that it stands for.
        self._choices = np.empty(0, int), np.empty(0, int)
        if isinstance(actions, spaces.Discrete | spaces.MultiDiscrete):
            counts = np.ravel(actions.n if isinstance(actions, spaces.Discrete) else actions.nvec)
            pairs = zip(np.ravel(actions.start).tolist(), counts.tolist(), strict=True)
            values = [np.arange(first, first + count) for first, count in pairs]
            self._choices = np.repeat(np.arange(len(counts)), counts), np.concatenate(values)
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
            age: Of the newest sample of each part, a list, or shape (N, parts) [steps].
            arrived: Whether one arrived, likewise.
            pending: The pending actions, oldest first, a sequence, or shape (N, pending, ...).
        """
        if not self.names:
            return observation
        added = {}
        for name in self.names:
            if name == "age":
                added[name] = np.minimum(age, OLDEST_OBSERVED).astype(np.float32)
            elif name == "arrived":
                added[name] = np.asarray(arrived, np.int8)
            else:
                added[name] = self._told(np.array(pending))  # the network writes on into its own
        if self._is_flat:
            shape = (*np.shape(observation)[:-1], -1)
            flat = [each.reshape(shape) for each in added.values()]
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
        columns, values = self._choices
        numbers = entries if entries.shape[-1] == 1 else entries[..., columns]
        return (numbers == values).view(np.int8)


def pending_space(actions: spaces.Space, pending: int) -> spaces.Box:
    """Returns the space of so many actions, the first axis; those that are no numbers as vectors of zeros and ones."""
    if isinstance(actions, spaces.Box):
        low, high = (np.broadcast_to(end, (pending, *actions.shape)) for end in (actions.low, actions.high))
        return spaces.Box(low, high, dtype=actions.dtype)  # type: ignore[arg-type]
    if isinstance(actions, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return spaces.Box(0, 1, (pending, spaces.flatdim(actions)), np.int8)
    raise ValueError(f"pending_actions are for actions that are one array, got {shown(actions)}")


# Keys of infos that are the network's own.
INFOS = (
    *("measurement_age", "packet_arrived", "action_age", "action_applied", "packets"),
    *("channel_loss", "channel_delay", "downlink_loss", "downlink_delay"),
)
_INFOS = frozenset(INFOS)
IDLE = "hold", "neutral"
# Keeps what the network draws apart from what an environment of the same seed draws.
NETWORK_STREAM = 0x6E6574
# What the agent sees instead of an old sample: (newest sample, its age, last actions, oldest first) -> observation.
Predictor = Callable[[Any, Any, Any], Any]


class NetworkSettings:
    """The settings of a network around an environment, read against its spaces.

    Args:
        observations: Space of the observations of one environment.
        actions: Space of its actions.
        settings: The keywords of `Networked` by name, as which they are kept where they are checked alone.

    Attributes:
        parts: The parts of observations that have a channel of their own.
        keys: Their keys; None for the whole observation.
        channels: Their channels.
        channel: The only one of them, or a dictionary of them by the keys of their parts.
        entries: What is added to observations.
        recorded: The settings as JSON values, as far as they can be.

    Raises:
        ValueError: If a setting is wrong, or does not fit the spaces.
    """

    def __init__(self, observations: spaces.Space, actions: spaces.Space, settings: Mapping[str, Any]) -> None:
        self.parts, given = parts_of(observations, settings["channel"])
        self.channels = [as_channel(each, "channel") or Channel() for each in given]
        for part, channel in zip(self.parts, self.channels, strict=True):
            if channel.quantization_step and not has_floats(part.space):
                raise ValueError(f"{shown(part.space)} has no floats to quantize: leave out quantization_step")
            _require_own_time(channel)
        self.keys = None if self.parts[0].key is None else [part.key for part in self.parts]
        self.channel = self.by_part(self.channels)
        self.downlink = as_channel(settings["downlink"], "downlink")
        downlink_protocol(self.downlink, None)  # raises where a setting makes no sense there
        self.fill: Any = settings["fill"]
        if not (callable(self.fill) or (isinstance(self.fill, str) and self.fill in ("last", "zero"))):
            raise ValueError(
                f"fill must be 'last', 'zero' or a function (last, age, actions) -> observation, got {shown(self.fill)}"
            )
        if callable(self.fill) and len(self.parts) > 1:
            raise ValueError("a function for fill is for one channel: it returns a whole observation")
        if self.fill == "zero":
            for part in self.parts:
                zero_of(part.space)
        self.idle = settings["idle"]
        if not (isinstance(self.idle, str) and self.idle in IDLE):
            raise ValueError(f"idle must be one of {', '.join(map(repr, IDLE))}, got {shown(self.idle)}")
        if self.downlink is None and self.idle != IDLE[0]:
            raise ValueError("idle is about a network of the actions: give downlink=Channel(...), too")
        self.neutral = _neutral(settings["neutral"], actions, needed=self.downlink is not None)
        given_pending = settings["pending"]
        self.pending = self._memory() if given_pending is None else as_count(given_pending, "pending", low=1, high=1000)
        self.entries = Entries(settings["observe"], observations, actions, len(self.parts), self.pending)
        if given_pending is not None and not ("pending_actions" in self.entries.names or callable(self.fill)):
            raise ValueError("pending is how many actions a predictor gets, or an agent that observes pending_actions")
        self._has_warned = False
        self.recorded = dict(settings) | {
            "channel": to_json(settings["channel"]),
            "downlink": to_json(settings["downlink"]),
            "neutral": to_json(settings["neutral"]),
            "observe": list(self.entries.names),
        }

    def by_part(self, values: list[Any]) -> Any:
        """Returns what belongs to the parts by their keys; what belongs to the whole observation alone."""
        return values[0] if self.keys is None else dict(zip(self.keys, values, strict=True))

    def links(self, count: int) -> dict[tuple[str, Any], EpisodeChannels]:
        """Returns the channels of so many environments by direction and key, those of the commands last."""
        pairs = zip(self.parts, self.channels, strict=True)
        up = {("channel", part.key): EpisodeChannels(each, _require_own_time, count) for part, each in pairs}
        require = partial(_require_downlink, self.downlink)
        return {**up, ("downlink", None): EpisodeChannels(self.downlink, require, count)}

    def infos(self, links: dict[tuple[str, Any], EpisodeChannels], *, many: bool = False) -> dict[str, Any]:
        """Returns what infos say of the networks of the present episodes, arrays of N environments."""
        *parts, commands = (each.infos(name, many=many) for (name, _), each in links.items())
        return {name: self.by_part([each[name] for each in parts]) for name in parts[0]} | commands

    def sources(
        self, options: dict[str, Any], links: dict[tuple[str, Any], EpisodeChannels]
    ) -> list[tuple[EpisodeChannels, list[Any] | None]]:
        """Returns the channels with what the options "channel" and "downlink" make of each, and takes the options out.

        Raises:
            ValueError: If one is no channel, or of keys that observations do not have.
        """
        given, downlink = options.pop("channel", None), options.pop("downlink", None)
        if self.keys is not None and isinstance(given, tuple | list) and len(given) == len(self.keys):
            given = dict(zip(self.keys, given, strict=True))  # as for a `Tuple` of observations
        each = dict.fromkeys(self.keys or [None], given)
        if isinstance(given, Mapping) and self.keys is not None:
            if unknown := [key for key in given if key not in self.keys]:
                raise ValueError(f"the option channel has the key {shown(unknown[0])}, the channels' are {self.keys}")
            each = {key: given.get(key) for key in self.keys}
        asked = [*each.values(), downlink]
        return [(found, found.read(one, name)) for one, ((name, _), found) in zip(asked, links.items(), strict=True)]

    def warn_of_lacking_actions(self, age: int) -> None:
        """Warns the caller, once, where a predictor lacks actions that were decided since the newest sample."""
        if age > self.pending and not self._has_warned:
            self._has_warned = True
            warn_caller(
                f"the newest sample is {counted(age, 'step')} old, and the predictor is given the last "
                f"{counted(self.pending, 'action')}: "
                f"give pending={age} or more, or say what the channel promises (max_consecutive_losses)",
                UserWarning,
            )

    def _memory(self) -> int:
        """Returns how many actions the newest sample may lack: what the contracts allow, or the usual age."""
        ages = [largest_age(contract_of(each), each.usual_age) for each in self.channels]
        if self.downlink is None:
            return max(*ages, 1)
        return max(max(ages) + downlink_protocol(self.downlink, None).input_delay, 1)


class ReadNetwork(RecordConstructorArgs, ABC):
    """Base of the wrappers: what they are made with is read, and never set; and what the network draws from."""

    channel: Any = setting("channel", "_settings.channel")
    downlink: Channel | None = setting("downlink", "_settings.downlink")
    pending: int = setting("pending", "_settings.pending")
    links: dict[tuple[str, Any], EpisodeChannels] = setting("links")

    _settings: NetworkSettings
    _rng: np.random.Generator | None = None

    def __init__(
        self,
        env: Any,
        channel: Channel | Mapping[str, Any] | tuple[Any, ...] | None = None,
        downlink: Channel | Mapping[str, Any] | None = None,
        observe: Sequence[str] = (),
        fill: str | Predictor = "last",
        idle: str = "hold",
        neutral: Any = None,
        pending: int | None = None,
    ) -> None:
        given = {"channel": channel, "downlink": downlink, "observe": observe, "fill": fill, "idle": idle}
        self._wrap(env, given | {"neutral": neutral, "pending": pending})
        require_no_restarts(env)
        RecordConstructorArgs.__init__(self, **self._settings.recorded)

    @abstractmethod
    def _wrap(self, env: Any, given: dict[str, Any]) -> None:
        """Sets up the wrapper around an environment, with `_settings`; raises ValueError if it does not fit."""

    @property
    def np_random(self) -> np.random.Generator:
        """What the network draws from; the environment's own draws do not change it."""
        if self._rng is None:
            self._rng = seeding.np_random()[0]
        return self._rng


def network_rng(seed: Any) -> np.random.Generator:
    """Returns what a network draws from; raises ValueError for what is no seed."""
    number = as_count(seed, "seed", low=0, high=2**64)
    return np.random.default_rng(np.random.SeedSequence(number, spawn_key=(NETWORK_STREAM,)))


def as_channel(value: Any, name: str) -> Channel | None:
    """Returns a channel, also one whose fields a dictionary holds, None for None; raises ValueError for others."""
    channel = from_json(value, (Channel,), name)
    if channel is None or isinstance(channel, Channel):
        return channel
    raise ValueError(f"{name} must be a Channel, or a dictionary of its fields, got {shown(value)}")


def _neutral(given: Any, actions: spaces.Space, needed: bool) -> Any:
    """Returns the action that is applied while no command has arrived, the zero of the space by default."""
    if given is None and not needed:
        return None
    if given is None:
        try:
            if not _has_choices(actions):
                return zero_of(actions)
        except ValueError:
            pass
        raise ValueError(
            f"before the first command arrives some action has to act, and {shown(actions)} has no zero: give neutral="
        )
    action = np.array(given, actions.dtype) if isinstance(actions, spaces.Box) else snapshot(given)
    if not actions.contains(action):
        raise ValueError(f"neutral must be an action, got {shown(given)}")
    return action


def _has_choices(actions: spaces.Space) -> bool:
    if isinstance(actions, spaces.Dict | spaces.Tuple):
        inner = actions.spaces.values() if isinstance(actions, spaces.Dict) else actions.spaces
        return any(map(_has_choices, inner))
    return isinstance(actions, spaces.Discrete | spaces.MultiDiscrete)


def _require_own_time(channel: Channel) -> None:
    if channel.on_request:
        raise ValueError("samples on request are for an NCSEnv: leave out on_request")


def _require_downlink(declared: Channel | None, channel: Channel) -> None:
    if declared is None:
        raise ValueError("the environment has an ideal downlink: make it with downlink=Channel(...)")
    downlink_protocol(channel, None)


def require_no_restarts(env: Any) -> None:
    """Raises ValueError if an environment begins episodes by itself in `step`: samples of one would reach the next."""
    layer = env
    while layer is not None:
        if isinstance(layer, Autoreset):
            raise ValueError("Autoreset inside begins episodes that the network does not know of: put it around")
        layer = vars(layer).get("env")


def require_no_network(info: Mapping[str, Any]) -> None:
    """Raises ValueError if infos of the environment have keys that are those of the network."""
    if not _INFOS.isdisjoint(info):
        taken = next(key for key in INFOS if key in info)
        raise ValueError(
            f"infos of the environment inside have the key {taken!r}, which is the network's: call it otherwise, or if "
            "another network put it there, have one network with all delays and losses"
        )


def require_action(actions: spaces.Space, given: Any) -> None:
    """Raises ValueError unless what is sent is an action: an environment would refuse it only when it acts, or never.

    Values beyond the limits of a box are the environment's to judge.
    """
    if isinstance(actions, spaces.Box):
        numbers = as_numbers(given)
        is_one = numbers is not None and numbers.shape == actions.shape and not np.isnan(numbers).any()
    else:
        is_one = actions.contains(given)
    if not is_one:
        raise ValueError(f"an action of {shown(actions)} is sent to the actuator, got {shown(given)}")
