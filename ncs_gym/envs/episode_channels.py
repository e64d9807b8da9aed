"""Which channel each environment has in its present episode: its own, another one, or one that is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorWrapper

from ncs_gym.envs.json_settings import from_json, to_json
from ncs_gym.network.channel import Channel, require_duration
from ncs_gym.network.downlink import DownlinkProtocol, require_fitting_downlink
from ncs_gym.validation import AroundEnvironments, shown

# Draws a channel; and which one: the option of `reset`, and of several channels the key.
_Draw = Callable[[np.random.Generator], Any]
_Which = tuple[str, Any]


class EveryEpisode(NamedTuple):
    """What the episodes of an environment draw their channels from, also those that begin by themselves.

    Attributes:
        draw: A function (rng) -> Channel.
        first: Takes its place in the first of these episodes: a channel, or what draws one; None for nothing. As an
            option of a vector environment it may be a list of these.
    """

    draw: Callable[[np.random.Generator], Channel]
    first: Any = None


class EpisodeChannels:
    """The channels of N environments in their present episodes, in one direction.

    Args:
        own: The channels that the environments were made with; None for an ideal one.
        require_fitting: Raises ValueError for a channel that the environments cannot have.

    Attributes:
        now: Those of the present episodes.
        is_plain: Whether all have the same one, and will have it in the next episode, too.
    """

    def __init__(self, own: Sequence[Channel | None], require_fitting: Callable[[Channel], None]) -> None:
        self._own, self._require_fitting = list(own), require_fitting
        for each in {channel for channel in own if channel is not None}:
            require_fitting(each)
        self._sources: list[Any] = self._own
        self.now: list[Any] = list(own)
        self._is_uniform = len(set(own)) == 1
        self.is_plain = self._is_uniform

    def read(self, option: Any, name: str) -> list[Any]:
        """Returns the sources that an option of `reset` names, one for each environment.

        Args:
            option: None for the environments' own; a channel (or a dictionary of its fields), or what draws one, for
                all; or N of these. All of them are for one episode, but for `EveryEpisode`.
            name: What the error message calls it.

        Raises:
            ValueError: If it is none of these, or a channel that the environments cannot have.
        """
        count, option = len(self._own), from_json(option, (Channel,), name)
        if option is None:
            return self._own
        if isinstance(option, EveryEpisode):
            firsts = [None] * count if option.first is None else self.read(option.first, name)
            return [EveryEpisode(option.draw, first) for first in firsts]
        each = [option] * count if isinstance(option, Channel) or callable(option) else option
        each = [from_json(one, (Channel,), name) for one in each] if isinstance(each, (list, tuple)) else each
        if not isinstance(each, (list, tuple)) or len(each) != count:
            several = "" if count == 1 else f", or a list of {count} of these"
            raise ValueError(f"{name} must be a Channel or a function (rng) -> Channel{several}, got {shown(option)}")
        for channel in {id(channel): channel for channel in each if not callable(channel)}.values():
            if channel is not None:
                self._checked(channel, name)
        return [own if given is None else given for given, own in zip(each, self._own, strict=True)]

    def drawn(self, sources: list[Any], rng: np.random.Generator, rows: Sequence[int] | None = None) -> list[Any]:
        """Returns sources in which those that draw have drawn for the next episodes of some environments.

        Args:
            sources: What `read` returned.
            rng: Draws.
            rows: Indices of these environments; all by default.

        Raises:
            ValueError: If what was drawn is no channel that the environments can have; nothing has changed then.
        """
        if not any(callable(each) or isinstance(each, EveryEpisode) for each in sources):
            return sources
        found = list(sources)
        for e in range(len(found)) if rows is None else rows:
            if isinstance(each := found[e], EveryEpisode):
                found[e] = each._replace(first=self._channel(each.draw if each.first is None else each.first, rng))
            else:
                found[e] = self._channel(each, rng)
        return found

    def give(self, sources: list[Any], chosen: Sequence[int] | None = None) -> None:
        """Takes what `read` returned for some environments, given by their indices; for all by default."""
        if chosen is None or len(chosen) == len(self._own):
            self._sources = list(sources)
            self.is_plain = self._is_uniform and sources is self._own
            self.now = list(self._own)
        elif sources is not self._own or not self.is_plain:
            self._sources, self.is_plain = list(self._sources), False
            for e in chosen:
                self._sources[e] = sources[e]

    def begin(self, rng: np.random.Generator, rows: np.ndarray | None = None) -> list[Any] | None:
        """Draws the channels of episodes that begin in some environments, given by their indices; in all by default.

        Returns:
            Those of all environments; None if all have the same one, as before.

        Raises:
            ValueError: If what was drawn is no channel that the environments can have.
        """
        if self.is_plain:
            return None
        for e in range(len(self.now)) if rows is None else rows.tolist():
            source, later = self._sources[e], self._own[e]
            if isinstance(source, EveryEpisode):
                source, later = source.draw if source.first is None else source.first, EveryEpisode(source.draw)
            self.now[e] = self._channel(source, rng)
            self._sources[e] = later
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

    def _channel(self, source: Any, rng: np.random.Generator) -> Any:
        """Returns the channel of an episode: what is given, or what it draws."""
        if not callable(source):
            return source
        return self._checked(from_json(source(rng), (Channel,), "what was drawn"), "what was drawn")

    def _checked(self, channel: Any, name: str) -> Channel:
        if not isinstance(channel, Channel):
            raise ValueError(f"{name} must be a Channel, got {shown(channel)}")
        self._require_fitting(channel)
        return channel


def uplinks(own: Sequence[Channel], declared: Channel, dt: float) -> EpisodeChannels:
    """Returns the channels between sensors and controllers, in steps of duration dt [s].

    None may round more coarsely than declared, or send samples on request if the declared one does not, or otherwise.
    """
    return EpisodeChannels(own, partial(_require_uplink, declared, dt))


def downlinks(own: Sequence[Channel | None], protocol: DownlinkProtocol, dt: float) -> EpisodeChannels:
    """Returns the channels between controllers and actuators, which keep the c steps of duration dt of a protocol."""
    return EpisodeChannels(own, partial(_require_downlink, protocol, dt))


def channel_infos(up: EpisodeChannels, down: EpisodeChannels, *, many: bool = False) -> dict[str, Any]:
    """Returns what infos say of the channels of the present episodes, of N environments arrays of shape (N,)."""
    return up.infos("channel", many=many) | down.infos("downlink", many=many)


def covering(channels: Sequence[Channel], declared: Channel) -> Channel:
    """Returns a channel with the delays of all, and the quantization step that environments were made for."""
    shortest = min(channel.delay for channel in channels)
    longest = max(channel.longest_delay for channel in channels)
    return Channel(quantization_step=declared.quantization_step, delay=shortest, jitter=longest - shortest)


class RandomChannel(gym.Wrapper, RecordConstructorArgs):
    """Draws a channel at the start of every episode (domain randomization over networks).

    The draws come from the environment's own `np_random`, so that a seed determines them. A shield may stand inside or
    outside. What the environment was made for bounds what may be drawn; see `NCSEnv.reset`.

    Args:
        env: An `NCSEnv`, or another environment in `Networked`, possibly wrapped.
        channel: A function (rng) -> Channel, or a list of channels (or dictionaries of their fields) of which each is
            equally likely; None for the environment's own. Several channels are drawn one by one: of the same, or of a
            dictionary of these by the channels' keys, where those that it leaves out stay the environment's own.
        downlink: The same for the commands.

    Raises:
        ValueError: If neither is given, it is none of these, or the environment has no channel of a key.
    """

    def __init__(self, env: gym.Env, channel: Any = None, downlink: Any = None) -> None:
        RecordConstructorArgs.__init__(self)
        if not isinstance(env, gym.Env):
            raise ValueError(f"RandomChannel takes an environment, as gym.make returns it, got {shown(env)}")
        gym.Wrapper.__init__(self, env)
        if not env.has_wrapper_attr("episode_channel"):
            raise ValueError(f"RandomChannel is for an NCSEnv, or any environment in Networked, got {env.unwrapped}")
        self.draw_from(channel, downlink)

    def draw_from(self, channel: Any = None, downlink: Any = None) -> None:
        """Takes the place of what was given: episodes from the next one on draw from it.

        Where environments are in processes of their own, vector environments call it there (docs/ncs_gym.md).

        Raises:
            ValueError: See `RandomChannel`.
        """
        self._keys = _keys(self.env.get_wrapper_attr("channel"))
        self._drawn = _drawn(self._keys, channel, downlink)
        self._saved_kwargs = {"channel": to_json(channel), "downlink": to_json(downlink)}
        self._cached_spec = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode; a channel among the options takes the place of a drawn one."""

        def source(which: _Which, first: Any) -> Any:
            return self._drawn[which] if first is None else first

        return self.env.reset(seed=seed, options=_options(self._keys, self._drawn, options, source))


class VectorRandomChannel(AroundEnvironments, VectorWrapper, RecordConstructorArgs):
    """`RandomChannel` for an `NCSVectorEnv`: one is drawn for every episode of every one, in any autoreset mode.

    Args:
        env: An `NCSVectorEnv`, or another one in `VectorNetworked`, possibly wrapped.
        channel: See `RandomChannel`.
        downlink: See `RandomChannel`.

    Raises:
        ValueError: See `RandomChannel`.
    """

    def __init__(self, env: Any, channel: Any = None, downlink: Any = None) -> None:
        RecordConstructorArgs.__init__(self)
        VectorWrapper.__init__(self, env)
        if not hasattr(env, "channel"):
            raise ValueError(f"VectorRandomChannel is for an NCSVectorEnv or VectorNetworked, got {env.unwrapped}")
        self._drawn: dict[_Which, _Draw] = {}
        self.draw_from(channel, downlink)

    def draw_from(self, channel: Any = None, downlink: Any = None) -> None:
        """See `RandomChannel.draw_from`; also for episodes that begin by autoreset.

        Raises:
            ValueError: See `RandomChannel`; or if another of channel and downlink was drawn until now.
        """
        self._keys = _keys(self.env.channel)  # pyright: ignore[reportAttributeAccessIssue]
        drawn = _drawn(self._keys, channel, downlink)
        if self._drawn and drawn.keys() != self._drawn.keys():
            given = dict.fromkeys(name if key is None else f"{name} of {key!r}" for name, key in self._drawn)
            raise ValueError(f"draw_from takes the place of what was given: give {' and '.join(given)}")
        self._drawn = drawn
        self._saved_kwargs = {"channel": to_json(channel), "downlink": to_json(downlink)}

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts episodes; channels among the options take the place of drawn ones, in these episodes."""

        def source(which: _Which, first: Any) -> Any:
            return EveryEpisode(partial(self._draw, which), first)

        options = _options(self._keys, self._drawn, options, source)
        # gymnasium's annotation leaves out the lists that its own vector environments take.
        return self.env.reset(seed=seed, options=options)  # pyright: ignore[reportArgumentType]

    def _draw(self, which: _Which, rng: np.random.Generator) -> Any:
        """Returns what is drawn now, whenever the environments began to ask for it."""
        return self._drawn[which](rng)


def _keys(channel: Any) -> list[Any]:
    """Returns the keys of an environment's channels; that of a single one is None."""
    return list(channel) if isinstance(channel, Mapping) else [None]


def _drawn(keys: list[Any], channel: Any, downlink: Any) -> dict[_Which, _Draw]:
    """Returns what channels are drawn from, by the option of `reset` and the key of a channel."""
    given: dict[_Which, Any] = {}
    if channel is not None:
        each = channel if isinstance(channel, Mapping) and keys != [None] else dict.fromkeys(keys, channel)
        if unknown := [key for key in each if key not in keys]:
            raise ValueError(f"channel has the key {shown(unknown[0])}, the channels' are {keys}")
        given = {("channel", key): source for key, source in each.items()}
    if downlink is not None:
        given["downlink", None] = downlink
    if not given:
        raise ValueError("give channel or downlink: a function (rng) -> Channel, or a list of channels")
    return {
        (name, key): _draw(source, name, keys if name == "channel" else [None]) for (name, key), source in given.items()
    }


def _draw(source: Any, name: str, keys: list[Any]) -> _Draw:
    """Returns what draws a channel, given a function or a list; `keys` are those of the channels in this direction."""
    if callable(source):
        return source
    choices = [from_json(each, (Channel,), name) for each in source] if isinstance(source, (list, tuple)) else []
    if not choices or not all(isinstance(each, Channel) for each in choices):
        by_key = "" if keys == [None] else f", or a dictionary of these by the keys {keys}"
        raise ValueError(
            f"{name} must be a function (rng) -> Channel or a list of channels{by_key}, got {shown(source)}"
        )
    return partial(_chosen, tuple(choices))


def _options(
    keys: list[Any], drawn: dict[_Which, _Draw], given: dict[str, Any] | None, source: Callable[[_Which, Any], Any]
) -> dict[str, Any]:
    """Returns the options of a reset, with what is drawn.

    Args:
        keys: Of the environment's channels.
        drawn: What channels are drawn from.
        given: The options that were given.
        source: Returns what an environment draws a channel from, and has instead if that is given.
    """
    options = dict(given or {})
    for name in dict.fromkeys(name for name, _ in drawn):
        own = options.get(name)
        if name == "downlink" or keys == [None]:
            options[name] = source((name, None), own)
        else:
            each = own if isinstance(own, Mapping) else dict.fromkeys(keys, own)
            several = {key: source((name, key), each.get(key)) for key in keys if (name, key) in drawn}
            options[name] = {**each, **several}
    return options


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
