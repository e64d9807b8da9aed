"""What a channel remembers during an episode: its loss process and the packets on their way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.network.channel import Channel, GilbertElliott, Packet, TraceChannel
from ncs_gym.validation import frozen

# More losses in a row than any episode has steps.
UNLIMITED = 2**31 - 1


class LossState(NamedTuple):
    """The loss process of one channel (numbers) or of N (arrays of shape (N,)).

    Attributes:
        bad: Whether the Gilbert-Elliott chain is in its bad state; of a `TraceChannel` the number of the next sample
            (of N channels with some of either 1 or 0 for the chains).
        consecutive: Number of packets that were lost in a row so far; counted where the channel limits it.
    """

    bad: Any
    consecutive: Any


class StackedBursts(NamedTuple):
    """What `GilbertElliott` has, for each of N channels, shape (N,) each; a constant loss is a chain that stays."""

    p_good_to_bad: np.ndarray
    p_bad_to_good: np.ndarray
    loss_good: np.ndarray
    loss_bad: np.ndarray
    stationary_bad: np.ndarray


class StackedChannels:
    """What `Channel` has, for each of N channels that differ, as arrays of shape (N,); `replays` are its records."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        of_records: dict[int, tuple[TraceChannel, list[int]]] = {}
        for e, each in enumerate(channels):
            if isinstance(each, TraceChannel):
                of_records.setdefault(id(each), (each, []))[1].append(e)
        self.replays = [(trace, np.array(rows)) for trace, rows in of_records.values()]
        self.on_request = channels[0].on_request  # of all, as environments require

        def stacked(*names: str) -> list[np.ndarray]:
            return [np.array([getattr(each, name) for each in channels]) for name in names]

        self.quantization_step, self.send_period, self.delay, jitter = stacked(
            "quantization_step", "send_period", "delay", "jitter"
        )
        self.jitter: Any = jitter if jitter.any() else 0  # without any, nothing is drawn
        limits = [each.max_consecutive_losses for each in channels]
        self.max_consecutive_losses: Any = None  # without any, nothing is counted
        if limits != [None] * len(limits):
            self.max_consecutive_losses = np.array([UNLIMITED if most is None else most for most in limits])
        losses = [each.loss for each in channels]
        self.loss: Any = np.array([0.0 if isinstance(each, GilbertElliott) else each for each in losses])
        if any(isinstance(each, GilbertElliott) for each in losses):
            chains = [each if isinstance(each, GilbertElliott) else _staying(each) for each in losses]
            names = StackedBursts._fields
            self.loss = StackedBursts(*(np.array([getattr(each, name) for each in chains]) for name in names))
        self.shortest_delay, self.longest_delay = int(self.delay.min()), int((self.delay + jitter).max())

    def quantize(self, measurements: np.ndarray) -> np.ndarray:
        """Returns measurements, shape (p, N), each rounded to multiples of its channel's quantization step."""
        q = self.quantization_step
        return np.where(q > 0.0, np.rint(measurements / np.where(q > 0.0, q, 1.0)) * q, measurements)


def side_by_side(channels: Sequence[Channel]) -> Channel | StackedChannels:
    """Returns channels as one that stands for all of them: itself if all are equal."""
    first = channels[0]
    return first if all(each is first or each == first for each in channels) else StackedChannels(channels)


def first_loss_state(
    channel: Channel | StackedChannels, rng: np.random.Generator, size: int | None = None
) -> LossState:
    """Returns the loss process at the start of an episode; a chain starts in its stationary distribution."""
    if isinstance(channel, TraceChannel):
        bad = rng.integers(len(channel.trace), size=size)
    elif isinstance(channel.loss, (GilbertElliott, StackedBursts)):
        bad = rng.random(size) < channel.loss.stationary_bad
    else:
        bad = False if size is None else np.zeros(size, np.bool_)
    if isinstance(channel, StackedChannels) and channel.replays:
        bad = np.asarray(bad, np.int64)
        for trace, rows in channel.replays:
            bad[rows] = rng.integers(len(trace.trace), size=len(rows))
    return LossState(bad, 0 if size is None else np.zeros(size, np.int64))


def transmit(
    channel: Channel | StackedChannels, rng: np.random.Generator, state: LossState, sends: Any
) -> tuple[LossState, Any]:
    """Moves the loss process one step on and sends a packet; the same text for one channel and for N.

    Args:
        channel: The settings, of N channels also stacked.
        rng: Source of randomness.
        state: The loss process before the step.
        sends: Whether a packet is sent at this step, a bool or shape (N,).

    Returns:
        The loss process after the step, and after how many steps the packet arrives: -1 if never.
    """
    size = sends.shape if isinstance(sends, np.ndarray) else None
    bad, consecutive = state
    if isinstance(channel, TraceChannel):
        delay = np.where(sends, channel.delays[bad], -1)
        following = (bad + sends) % len(channel.trace)
        return LossState(following, consecutive), int(delay) if size is None else delay
    if isinstance(channel, StackedChannels) and channel.replays:
        moved, delay = _transmit_by_chance(channel, rng, state, sends)
        following, delay = moved.bad.astype(np.int64), delay.astype(np.int64)
        for trace, rows in channel.replays:
            at, sent = bad[rows], sends[rows]
            following[rows], delay[rows] = (at + sent) % len(trace.trace), np.where(sent, trace.delays[at], -1)
        return LossState(following, moved.consecutive), delay
    return _transmit_by_chance(channel, rng, state, sends)


def _transmit_by_chance(
    channel: Channel | StackedChannels, rng: np.random.Generator, state: LossState, sends: Any
) -> tuple[LossState, Any]:
    size = sends.shape if isinstance(sends, np.ndarray) else None
    bad, consecutive = state
    loss: Any = channel.loss
    if isinstance(loss, (GilbertElliott, StackedBursts)):
        bad = bad != (rng.random(size) < loss.p_good_to_bad + (loss.p_bad_to_good - loss.p_good_to_bad) * bad)
        loss = loss.loss_good + (loss.loss_bad - loss.loss_good) * bad
    if not (sends if size is None else np.count_nonzero(sends)):  # quicker than any()
        return LossState(bad, consecutive), -1 if size is None else np.full(size, -1)
    arrives = sends & (rng.random(size) >= loss)
    if channel.max_consecutive_losses is not None:
        arrives = arrives | (sends & (consecutive >= channel.max_consecutive_losses))
        consecutive = (consecutive + sends) * (1 - arrives)
    delay: Any = channel.delay
    if isinstance(channel.jitter, np.ndarray) or channel.jitter:
        delay = delay + rng.random(size) * (channel.jitter + 1) // 1
    return LossState(bad, consecutive), arrives * (delay + 1) - 1


class ChannelState:
    """One channel during one episode.

    Attributes:
        in_flight: The packets on their way, by the step at which they arrive.
        requested: Whether the next sample is requested, of a channel that takes samples on request.
    """

    def __init__(self, channel: Channel, rng: np.random.Generator) -> None:
        self.channel, self.requested = channel, False
        self.in_flight: dict[int, list[Any]] = {}
        self._loss_state = first_loss_state(channel, rng)

    def sends_at(self, step: int) -> bool:
        """Returns whether the sensor sends at this step."""
        return self.requested if self.channel.on_request else step % self.channel.send_period == 0

    def exchange(
        self, rng: np.random.Generator, step: int, measurement: np.ndarray | None, episode: int = 0
    ) -> list[Packet]:
        """Puts a sample on the channel; returns the packets that arrive at this step, in the order of sending.

        How much is drawn does not depend on the measurement, shape (p,); None where `sends_at` is False. The packet
        carries the number of the episode.
        """
        sample = None if measurement is None else Packet(step, self.channel.quantize(measurement), episode)
        return self.carry(rng, step, sample)

    def carry(self, rng: np.random.Generator, step: int, packet: Any) -> list[Any]:
        """Puts a packet of any kind on the channel as it is, None for nothing; returns those that arrive at a step."""
        self._loss_state, delay = transmit(self.channel, rng, self._loss_state, packet is not None)
        if delay >= 0:
            self.in_flight.setdefault(step + int(delay), []).append(packet)
        return self.in_flight.pop(step, [])


class VectorChannelState:
    """The channels of N environments; `channel` are their settings, stacked if they differ."""

    def __init__(self, channel: Channel | Sequence[Channel], rng: np.random.Generator, size: int) -> None:
        self.channel = channel if isinstance(channel, Channel) else side_by_side(channel)
        self._size = size
        self._all = frozen(np.ones(size, np.bool_))  # which send where each step has a sample
        self._loss_state = first_loss_state(self.channel, rng, size)
        # For the samples of each age, after how many steps they arrive.
        self._delays = [np.full(size, -1) for _ in range(self.channel.longest_delay + 1)]

    def begin(self, rng: np.random.Generator, rows: np.ndarray, channels: Sequence[Channel] | None = None) -> None:
        """Starts episodes in some environments; what is on its way there never arrives.

        Args:
            rng: Source of randomness.
            rows: Indices of the environments.
            channels: Those of all N environments from now on; None for all the same as before, where they do not
            differ.
        """
        begun: Any = self.channel
        if channels is not None:
            self.channel, begun = side_by_side(channels), side_by_side([channels[e] for e in rows.tolist()])
            self._delays += [np.full(self._size, -1) for _ in range(self.channel.longest_delay + 1 - len(self._delays))]
        first, (bad, consecutive) = first_loss_state(begun, rng, len(rows)), self._loss_state
        bad = bad.astype(np.result_type(bad, first.bad))  # numbers of samples, where records are replayed
        bad[rows], consecutive[rows] = first
        self._loss_state = LossState(bad, consecutive)
        for delays in self._delays:
            delays[rows] = -1

    def send(self, rng: np.random.Generator, steps: np.ndarray, requested: np.ndarray | None = None) -> np.ndarray:
        """Sends samples where it is time, at steps (N,) of the episodes; returns which environments send, (N,).

        On request `requested`, (N,), says where.
        """
        period, sends = self.channel.send_period, requested
        if sends is None:
            sends = self._all if isinstance(period, int) and period == 1 else steps % period == 0
        self._loss_state, delays = transmit(self.channel, rng, self._loss_state, sends)
        self._delays = [delays, *self._delays[:-1]]
        return sends

    def discard(self, chosen: Any) -> None:
        """Loses the samples that were just sent by some environments."""
        self._delays[0][chosen] = -1

    def arrivals(self) -> list[tuple[int, np.ndarray]]:
        """Returns the ages of the samples that arrive now, oldest first, each with the environments (N,)."""
        found, channel = [], self.channel
        shortest = channel.shortest_delay if isinstance(channel, StackedChannels) else channel.delay
        for age in range(len(self._delays) - 1, shortest - 1, -1):
            arrives = self._delays[age] == age
            if np.count_nonzero(arrives):
                found.append((age, arrives))
        return found


def _staying(loss: float) -> GilbertElliott:
    return GilbertElliott(p_good_to_bad=0.0, p_bad_to_good=0.0, loss_good=loss, loss_bad=loss)
