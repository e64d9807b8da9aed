"""What `Networked` and `VectorNetworked` are made with, checked once for both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.wrappers import Autoreset

from ncs_gym.envs.episode_channels import EpisodeChannels
from ncs_gym.envs.json_settings import from_json, to_json
from ncs_gym.network.channel import Channel
from ncs_gym.network.contract import contract_of, largest_age
from ncs_gym.network.downlink import downlink_protocol
from ncs_gym.networked.observations import Entries, has_floats, parts_of, snapshot, zero_of
from ncs_gym.validation import as_count, as_numbers, counted, setting, shown, warn_caller

# Keys of infos that are the network's own.
INFOS = (
    *("measurement_age", "packet_arrived", "action_age", "action_applied", "packets"),
    *("channel_loss", "channel_delay", "downlink_loss", "downlink_delay"),
)
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
    ) -> list[tuple[EpisodeChannels, list[Any]]]:
        """Returns the channels with what the options "channel" and "downlink" make of each, and takes the options out.

        Raises:
            ValueError: If one is no channel, or of keys that observations do not have.
        """
        given, downlink = options.pop("channel", None), options.pop("downlink", None)
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


class ReadNetwork:
    """Mixin of the wrappers: what they are made with is read, and never set; and what the network draws from."""

    channel: Any = setting("channel", "_settings.channel")
    downlink: Channel | None = setting("downlink", "_settings.downlink")
    pending: int = setting("pending", "_settings.pending")
    links: dict[tuple[str, Any], EpisodeChannels] = setting("links")

    _settings: NetworkSettings
    _rng: np.random.Generator | None = None

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
    if taken := [key for key in INFOS if key in info]:
        raise ValueError(
            f"infos of the environment inside have the key {taken[0]!r}, which is the network's: call it otherwise, or "
            "if another network put it there, have one network with all delays and losses"
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
