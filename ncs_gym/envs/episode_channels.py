"""Which channel each environment has in its present episode: its own, another one, or one that is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorWrapper

from ncs_gym.envs.json_settings import from_json, to_json
from ncs_gym.network.channel import Channel, require_duration
from ncs_gym.network.downlink import DownlinkProtocol, require_fitting_downlink
from ncs_gym.validation import AroundEnvironments, shown

# Draws a channel, or the fields of one.
Draw = Callable[[np.random.Generator], Any]


class EpisodeChannels:
    """The channels of N environments in their present episodes, in one direction.

    A source is a channel or a function (rng) -> Channel; None stands for the environments' own.

    Args:
        declared: The channel that the environments were made with; None for an ideal one.
        require_fitting: Raises ValueError for a channel that the environments cannot have.
        count: N.

    Attributes:
        now: Those of the present episodes.
        is_plain: Whether all have the declared one.
    """

    def __init__(self, declared: Channel | None, require_fitting: Callable[[Channel], None], count: int = 1) -> None:
        self._declared, self._require_fitting = declared, require_fitting
        if declared is not None:
            require_fitting(declared)
        self._own: Channel | Draw | None = declared
        self.now: list[Any] = [declared] * count
        self.is_plain = True

    def draw_from(self, draw: Draw | None) -> None:
        """Has all episodes that begin from now on draw their channels; None for the declared one again."""
        self._own = draw or self._declared

    def read(self, option: Any, name: str) -> list[Any] | None:
        """Returns the sources that an option of `reset` names, one for each environment; None without the option.

        Args:
            option: A source for all, or N of them; a channel also as a dictionary of its fields.
            name: What the error message calls it.

        Raises:
            ValueError: If it is none of these, or a channel that the environments cannot have.
        """
        if option is None:
            return None
        count, option = len(self.now), from_json(option, (Channel,), name)
        each = [option] * count if isinstance(option, Channel) or callable(option) else option
        each = [from_json(one, (Channel,), name) for one in each] if isinstance(each, (list, tuple)) else each
        if not isinstance(each, list) or len(each) != count:
            several = "" if count == 1 else f", or a list of {count} of these"
            raise ValueError(f"{name} must be a Channel or a function (rng) -> Channel{several}, got {shown(option)}")
        for source in {id(source): source for source in each}.values():
            if source is not None and not callable(source):
                self._checked(source, name)
        return each

    def choose(self, sources: list[Any] | None, rng: np.random.Generator, rows: Sequence[int]) -> dict[int, Any]:
        """Returns the channels of the next episodes of some environments, by their indices; `begin` takes them.

        Args:
            sources: What `read` returned; None for the environments' own.
            rng: Draws those that are drawn.
            rows: Indices of these environments.

        Returns:
            An empty dictionary where all have the declared one, as before.

        Raises:
            ValueError: If what was drawn is no channel that the environments can have.
        """
        if sources is None and self.is_plain and self._own is self._declared:
            return {}
        chosen = {}
        for e in rows:
            source = self._own if sources is None or sources[e] is None else sources[e]
            if callable(source):
                drawn = from_json(source(rng), (Channel,), "what was drawn")
                source = self._checked(drawn, "what was drawn")
            chosen[e] = source
        return chosen

    def begin(self, chosen: dict[int, Any]) -> list[Any] | None:
        """Takes what `choose` returned; returns the channels of all environments, None if they are as before."""
        if not chosen:
            return None
        for e, channel in chosen.items():
            self.now[e] = channel
        self.is_plain = all(each is self._declared for each in self.now)
        return self.now

    def infos(self, name: str, *, many: bool) -> dict[str, Any]:
        """Returns what infos say of the channels of the present episodes; floats and ints, or arrays of shape (N,).

        Args:
            name: What the keys begin with.
            many: Whether there are N environments.
        """
        losses = [0.0 if each is None else each.mean_loss for each in self.now]
        delays = [0 if each is None else each.longest_delay for each in self.now]
        if not many:
            return {f"{name}_loss": losses[0], f"{name}_delay": delays[0]}
        return {f"{name}_loss": np.array(losses), f"{name}_delay": np.array(delays)}

    def _checked(self, channel: Any, name: str) -> Channel:
        if not isinstance(channel, Channel):
            raise ValueError(f"{name} must be a Channel, got {shown(channel)}")
        self._require_fitting(channel)
        return channel


def uplinks(declared: Channel, dt: float, count: int) -> EpisodeChannels:
    """Returns the channels between sensors and controllers, in steps of duration dt [s].

    None may round more coarsely than declared, or send samples on request if the declared one does not, or otherwise.
    """
    return EpisodeChannels(declared, partial(_require_uplink, declared, dt), count)


def downlinks(declared: Channel | None, protocol: DownlinkProtocol, dt: float, count: int) -> EpisodeChannels:
    """Returns the channels between controllers and actuators, which keep the c steps of duration dt of a protocol."""
    return EpisodeChannels(declared, partial(_require_downlink, protocol, dt), count)


def covering(channels: Sequence[Channel], declared: Channel) -> Channel:
    """Returns a channel with the delays of all, and the quantization step that environments were made for."""
    shortest = min(channel.delay for channel in channels)
    longest = max(channel.longest_delay for channel in channels)
    return Channel(quantization_step=declared.quantization_step, delay=shortest, jitter=longest - shortest)


class _Draws(RecordConstructorArgs):
    """What both wrappers have in common."""

    env: Any
    _kind: str
    _wrapper: Any

    def __init__(self, env: Any, channel: Any = None, downlink: Any = None) -> None:
        RecordConstructorArgs.__init__(self)
        self._wrapper.__init__(self, env)
        self.draw_from(channel, downlink)

    def draw_from(self, channel: Any = None, downlink: Any = None) -> None:
        """Takes the place of what was given: episodes from the next one on draw from it.

        Where environments are in processes of their own, vector environments call it there (docs/ncs_gym.md).

        Raises:
            ValueError: See the class.
        """
        layer = self.env
        while not hasattr(type(layer), "links") and layer is not layer.unwrapped:
            layer = layer.env
        if not hasattr(type(layer), "links"):
            raise ValueError(f"{type(self).__name__} is for {self._kind}, got {layer}")
        links: dict[tuple[str, Any], EpisodeChannels] = layer.links
        drawn = _drawn([key for name, key in links if name == "channel"], channel, downlink)
        for which, each in links.items():
            each.draw_from(drawn.get(which))
        self._saved_kwargs = {"channel": to_json(channel), "downlink": to_json(downlink)}
        self._cached_spec = None


class RandomChannel(_Draws, gym.Wrapper):
    """Draws a channel at the start of every episode (domain randomization over networks).

    The draws come from the environment's own `np_random`, so that a seed determines them. The wrapper has the
    environment draw, by whatever name it is called from then on; a shield may stand inside or outside. A channel among
    the options of `reset` takes the place of a drawn one. What the environment was made for bounds what may be drawn;
    see `NCSEnv.reset`.

    Args:
        env: An `NCSEnv`, or another environment in `Networked`, possibly wrapped.
        channel: A function (rng) -> Channel, or a list of channels (or dictionaries of their fields) of which each is
            equally likely; None for the environment's own. Several channels are drawn one by one: of the same, or of a
            dictionary of these by the channels' keys, where those that it leaves out stay the environment's own.
        downlink: The same for the commands.

    Raises:
        ValueError: If neither is given, it is none of these, or the environment has no channel of a key.
    """

    _kind, _wrapper = "an NCSEnv, or any environment in Networked", gym.Wrapper


class VectorRandomChannel(_Draws, AroundEnvironments, VectorWrapper):
    """`RandomChannel` for an `NCSVectorEnv`: one is drawn for every episode of every one, in any autoreset mode.

    Args:
        env: An `NCSVectorEnv`, or another one in `VectorNetworked`, possibly wrapped.
        channel: See `RandomChannel`.
        downlink: See `RandomChannel`.

    Raises:
        ValueError: See `RandomChannel`.
    """

    _kind, _wrapper = "an NCSVectorEnv or VectorNetworked", VectorWrapper


def _drawn(keys: list[Any], channel: Any, downlink: Any) -> dict[tuple[str, Any], Draw]:
    """Returns what channels are drawn from, by their direction and their key; that of a single channel is None."""
    given: dict[tuple[str, Any], Any] = {}
    if channel is not None:
        each = channel if isinstance(channel, Mapping) and keys != [None] else dict.fromkeys(keys, channel)
        if unknown := [key for key in each if key not in keys]:
            raise ValueError(f"channel has the key {shown(unknown[0])}, the channels' are {keys}")
        given = {("channel", key): source for key, source in each.items()}
    if downlink is not None:
        given["downlink", None] = downlink
    if not given:
        raise ValueError("give channel or downlink: a function (rng) -> Channel, or a list of channels")
    return {which: _draw(source, which[0]) for which, source in given.items()}


def _draw(source: Any, name: str) -> Draw:
    """Returns what draws a channel, given a function or a list."""
    if callable(source):
        return source
    choices = [from_json(each, (Channel,), name) for each in source] if isinstance(source, (list, tuple)) else []
    if not choices or not all(isinstance(each, Channel) for each in choices):
        raise ValueError(
            f"{name} must be a function (rng) -> Channel or a list of channels, of several channels also a dictionary "
            f"of these by their keys, got {shown(source)}"
        )
    return partial(_chosen, tuple(choices))


def _chosen(choices: tuple[Channel, ...], rng: np.random.Generator) -> Channel:
    return choices[int(rng.integers(len(choices)))]


def _require_downlink(protocol: DownlinkProtocol, dt: float, channel: Channel) -> None:
    """Raises ValueError if a downlink in steps of duration dt [s] cannot have another channel."""
    require_duration(channel, dt)
    require_fitting_downlink(protocol, channel)


def _require_uplink(declared: Channel, dt: float, channel: Channel) -> None:
    """Raises ValueError if an environment made for one channel, in steps of duration dt [s], cannot have another."""
    require_duration(channel, dt)
    coarsest = declared.quantization_step
    if channel.quantization_step > coarsest:
        raise ValueError(
            f"the channel rounds to {channel.quantization_step}, the environment was made for no more than "
            f"{coarsest}: make it with the coarsest of its channels"
        )
    if channel.on_request != declared.on_request:
        kind = "on request" if declared.on_request else "by itself"
        raise ValueError(
            f"the environment was made for a channel that sends samples {kind}: give one with "
            f"on_request={declared.on_request}"
        )
