"""The settings of a network between sensor and controller, its packets, and what a channel promises."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, fields
from functools import cached_property
from math import inf, isclose
from operator import index
from typing import Any, NamedTuple, overload

import numpy as np

from ncs_gym.reading import MOST_PACKETS
from ncs_gym.validation import (
    ReadOnlyArrays,
    as_count,
    as_flag,
    as_number,
    as_numbers,
    counted,
    read_only,
    shown,
    warn_caller,
)

# There is an error set for every age.
MAX_AGE = 1000
# Packets in flight are kept in memory, for every environment [steps].
LONGEST_DELAY = 1000
# Share of steps in which the newest sample may be older than it usually is.
UNUSUAL = 0.05


class Packet(NamedTuple):
    """A sample on its way.

    Attributes:
        stamp: Step at which the sample was taken, counted from the start of its episode.
        measurement: The (quantized) measurement, shape (p,).
        episode: Number of that episode, counted from 0; an estimator discards packets of any but its own.
    """

    stamp: int
    measurement: np.ndarray
    episode: int = 0


@dataclass(frozen=True, kw_only=True)
class GilbertElliott(ReadOnlyArrays):
    """Bursty loss: a two-state Markov chain that moves once per control step (Gilbert 1960, Elliott 1963).

    Attributes:
        p_good_to_bad: Probability to go from good to bad.
        p_bad_to_good: Probability to go from bad to good.
        loss_good: Loss probability of a packet sent in the good state.
        loss_bad: Loss probability of a packet sent in the bad state.

    Raises:
        ValueError: If a value is not a probability.
    """

    p_good_to_bad: float
    p_bad_to_good: float
    loss_good: float = 0.0
    loss_bad: float = 1.0

    def __post_init__(self) -> None:
        self._check(as_number, "p_good_to_bad", "p_bad_to_good", "loss_good", "loss_bad", low=0.0, high=1.0)

    @property
    def stationary_bad(self) -> float:
        """Long-run probability of the bad state (0 if the chain never moves)."""
        total = self.p_good_to_bad + self.p_bad_to_good
        return self.p_good_to_bad / total if total > 0.0 else 0.0


@dataclass(frozen=True)
class Channel(ReadOnlyArrays):
    """What the network does to the samples; every impairment works alone and with the others.

    At each step k >= 1 that is a multiple of `send_period` the measurement is quantized, stamped with k
    and sent. It is lost with probability `loss`; otherwise it arrives `delay` steps later plus a
    uniformly random 0..`jitter` more, so packets may overtake each other.

    Attributes:
        loss: Probability of losing a packet (1.0 is a blackout), or a `GilbertElliott` or a dictionary of its fields.
        quantization_step: Step q of the uniform mid-tread quantizer, in the units of y; 0 does not round.
        send_period: Steps between samples.
        delay: Fixed delay [steps].
        jitter: Largest extra random delay [steps].
        max_consecutive_losses: Never lose more packets in a row than this; None promises nothing.
        on_request: Whether a sample is taken only where the controller asks for it, or the contract needs it, instead
            of every `send_period` steps (docs/requests.md).

    Raises:
        ValueError: If a value is out of range.
    """

    loss: float | GilbertElliott = 0.0
    _: KW_ONLY  # so that Channel(0.3, 2) is not one that rounds to multiples of 2
    quantization_step: float = 0.0
    send_period: int = 1
    delay: int = 0
    jitter: int = 0
    max_consecutive_losses: int | None = None
    on_request: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.loss, dict):
            self._set(loss=_bursts(self.loss))
        if not isinstance(self.loss, GilbertElliott):
            self._check(as_number, "loss", low=0.0, high=1.0)
        self._check(as_number, "quantization_step", low=0.0)
        self._check(as_count, "send_period", low=1)
        self._check(as_count, "delay", "jitter", low=0, high=LONGEST_DELAY)
        if self.max_consecutive_losses is not None:
            self._check(as_count, "max_consecutive_losses", low=0)
        if as_flag(self.on_request, "on_request") and self.send_period != 1:
            raise ValueError(
                f"on request every step may have a sample: leave out send_period, which is {self.send_period}"
            )

    @property
    def most_consecutive_losses(self) -> int | None:
        """How many packets can be lost in a row; None if there is no limit."""
        never = self.loss == 0.0 or (
            isinstance(self.loss, GilbertElliott) and self.loss.loss_good == self.loss.loss_bad == 0.0
        )
        return 0 if never else self.max_consecutive_losses

    @cached_property
    def mean_loss(self) -> float:
        """Long-run share of samples that are lost, one every `send_period` steps."""
        bursts = self._bursts
        if self.max_consecutive_losses is None:
            bad = bursts.stationary_bad
            return (1.0 - bad) * bursts.loss_good + bad * bursts.loss_bad
        return _mean_loss(bursts, self.send_period, self.max_consecutive_losses)

    @property
    def _bursts(self) -> GilbertElliott:
        if isinstance(self.loss, GilbertElliott):
            return self.loss
        return GilbertElliott(p_good_to_bad=0.0, p_bad_to_good=0.0, loss_good=self.loss)

    @property
    def longest_delay(self) -> int:
        """The largest number of steps between a sample and its arrival."""
        return self.delay + self.jitter

    @property
    def oldest_age(self) -> int | None:
        """The largest age of the newest sample that has arrived, h = (l+1) M + delay - 1 [steps]; None without a limit.

        With a sample every M steps, at most l losses in a row and a longest delay of `delay` steps: among l+1
        consecutive samples one arrives, so at every step a sample at most (l+1) M - 1 + delay steps old has arrived.
        """
        losses = self.most_consecutive_losses
        return None if losses is None else (losses + 1) * self.send_period + self.longest_delay - 1

    @property
    def usual_age(self) -> int:
        """An age that the newest sample exceeds in at most `UNUSUAL` of the steps, by losses in a row alone [steps].

        That of no losses where they do not end, or last for longer than 1000 steps.
        """
        bursts, bad = self._bursts, self._bursts.stationary_bad
        shares, N = np.array([1.0 - bad, bad]), _chain(bursts, self.send_period) * [bursts.loss_good, bursts.loss_bad]
        shares = shares @ N
        ages = range(self.send_period + self.longest_delay - 1, LONGEST_DELAY + 1, self.send_period)
        for age in ages:
            if shares.sum() <= UNUSUAL:
                return age
            shares = shares @ N
        return ages.start

    @property
    def description(self) -> str:
        """What the channel does to samples, in sentences."""
        every = "every step" if self.send_period == 1 else f"every {counted(self.send_period, 'step')}"
        every = "on request" if self.on_request else every
        rounded = f"quantized with step {self.quantization_step:g}" if self.quantization_step else "not quantized"
        if isinstance(self.loss, GilbertElliott):
            lost = f"Losses come in bursts ({self.loss})"
        else:
            lost = f"A packet is lost with probability {self.loss:g}"
        if self.max_consecutive_losses is not None:
            lost += f", never more than {self.max_consecutive_losses} in a row"
        late = f"{self.delay} to {self.longest_delay} steps" if self.jitter else counted(self.delay, "step")
        arrives = f"What is not lost arrives {late} late" if self.longest_delay else "What is not lost arrives at once"
        return f"A sample is taken and sent {every}, {rounded}. {lost}. {arrives}."

    def quantize(self, measurement: np.ndarray) -> np.ndarray:
        """Returns the measurement, of any shape, rounded to multiples of the quantization step."""
        q = self.quantization_step
        return np.rint(measurement / q) * q if q > 0.0 else measurement


def _chain(bursts: GilbertElliott, period: int) -> np.ndarray:
    """Returns the transition matrix of bursts from one packet to the next, shape (2, 2)."""
    good, bad = bursts.p_good_to_bad, bursts.p_bad_to_good
    return np.linalg.matrix_power(np.array([[1.0 - good, good], [bad, 1.0 - bad]]), period)


def _mean_loss(bursts: GilbertElliott, period: int, most: int) -> float:
    """Returns the long-run share of packets that are lost, of one every so many steps and at most `most` in a row.

    With M the chain from one packet to the next and N its part with a loss, a cycle from one arrival to the next that
    begins in the states a has on average a (1 + N + .. + N^most) 1 packets, one of which arrives.
    """
    M = _chain(bursts, period)
    N = M * [bursts.loss_good, bursts.loss_bad]
    stacked = np.linalg.matrix_power(np.block([[N, np.eye(2)], [np.zeros((2, 2)), np.eye(2)]]), most)
    last, before = stacked[:2, :2], stacked[:2, 2:]  # N^most, and the sum of the powers below it
    cycle = before @ (M - N) + last @ M
    leaves, comes_back = cycle[0, 1], cycle[1, 0]
    at_arrivals = bursts.stationary_bad if leaves + comes_back == 0.0 else leaves / (leaves + comes_back)
    packets = np.array([1.0 - at_arrivals, at_arrivals]) @ (before + last) @ np.ones(2)
    return float(1.0 - 1.0 / packets)


def require_on_request(requests: Any) -> Any:
    """Returns the requests of a channel that takes samples on request; raises ValueError if there are none."""
    if requests is None:
        raise ValueError("the channel sends samples by itself: make it with Channel(..., on_request=True)")
    return requests


def require_duration(channel: Channel, dt: float) -> None:
    """Raises ValueError if a channel replays a record in steps of another duration than dt [s]."""
    if isinstance(channel, TraceChannel) and channel.dt is not None and not isclose(channel.dt, dt, rel_tol=1e-6):
        raise ValueError(
            f"the channel replays a record in steps of {channel.dt:g} s, and steps take {dt:g} s here: make another "
            f"one with PacketLog.channel({dt:g})"
        )


def in_time(seconds: float) -> str:
    """Returns a duration with its unit: milliseconds, seconds or hours."""
    if seconds < 0.9995:
        return f"{1000.0 * seconds:.3g} ms"
    return f"{seconds:.4g} s" if seconds < 3600.0 else f"{seconds / 3600.0:,.4g} h"


def _bursts(loss: dict[str, Any]) -> GilbertElliott:
    try:
        return GilbertElliott(**loss)
    except TypeError:
        names = ", ".join(entry.name for entry in fields(GilbertElliott))
        raise ValueError(
            f"loss must be a probability or the fields of GilbertElliott ({names}), got {shown(loss)}"
        ) from None


@dataclass(frozen=True, kw_only=True)
class TraceChannel(Channel):
    """A channel that replays what happened to the samples of a record, from a random one on and around again.

    `PacketLog.channel` makes one of recorded packets. Every `send_period` steps the next entry of the trace is what
    happens to the sample of that step; where nothing was sent it is lost. The contract of the channel is the largest
    age of the replay (`oldest_age`). On request (`on_request`) the next entry is that of the next sample that is asked
    for, so that an outage does not end before as many samples are lost as in the record.

    Attributes:
        trace: After how many steps each sample arrived, one after the other; -1 for one that was lost, or never sent.
        dt: Duration of these steps, which is then that of every environment with this channel [s]; None for any.

    Raises:
        ValueError: If the trace is empty, has other entries or more than two million of them, a loss or delay is
            given that is not the trace's, or dt is not positive.
    """

    trace: tuple[int, ...] = ()
    dt: float | None = None

    def __post_init__(self) -> None:
        if isinstance(self.trace, str) or len(self.trace) == 0:
            raise ValueError(
                f"trace must be the delays of recorded packets, -1 for a lost one, got {shown(self.trace)}"
            )
        if len(self.trace) > MOST_PACKETS:
            raise ValueError(f"a trace has at most {MOST_PACKETS:,} packets, got {len(self.trace):,}")
        if self.dt is not None:
            self._check(as_number, "dt", low=0.0, low_open=True)
        trace = tuple(as_count(each, "a delay of the trace", low=-1, high=LONGEST_DELAY) for each in self.trace)
        arrived = [each for each in trace if each >= 0] or [0]
        own = {
            "trace": trace,
            "loss": trace.count(-1) / len(trace),
            "delay": min(arrived),
            "jitter": max(arrived) - min(arrived),
            "max_consecutive_losses": None if max(trace) < 0 else _longest_run(trace),
        }
        defaults = {entry.name: entry.default for entry in fields(self)}
        for name, value in own.items():
            if name != "trace" and getattr(self, name) not in (value, defaults[name]):
                raise ValueError(f"{name} of a TraceChannel is that of its trace, {value}: leave it out")
        self._set(**own)
        super().__post_init__()

    def __repr__(self) -> str:
        more = f", on_request={self.on_request}" if self.on_request else ""
        more += "" if self.dt is None else f", dt={self.dt}"
        return (
            f"TraceChannel(trace={reprlib.repr(self.trace)} of {counted(len(self.trace), 'sample')}, "
            f"send_period={self.send_period}, quantization_step={self.quantization_step}{more})"
        )

    @cached_property
    def mean_loss(self) -> float:
        """Share of the trace that is lost."""
        return self.trace.count(-1) / len(self.trace)

    @cached_property
    def delays(self) -> np.ndarray:
        """The trace as an array, shape (k,) [steps]."""
        return read_only(np.array(self.trace))

    @cached_property
    def oldest_age(self) -> int | None:
        """The largest age of the newest sample in a replay without end [steps]; None if nothing arrives.

        On request the limit is that of the longest run of losses and the longest delay.
        """
        if self.on_request or self.max_consecutive_losses is None:
            return super().oldest_age
        twice = 2 * len(self.trace) * self.send_period + self.longest_delay
        return int(replayed_ages(self.delays, self.send_period, twice).max())

    @property
    def description(self) -> str:
        """What the channel does to samples, in sentences."""
        return (
            f"{super().description} It replays a record of {counted(len(self.trace), 'packet')} from a random one on."
        )


def replayed_ages(trace: np.ndarray, send_period: int, steps: int) -> np.ndarray:
    """Returns the age of the newest sample that has arrived at every step of a replay, shape (steps,) [steps].

    The replay begins with the first sample of the trace at step 0, where the first estimate counts as a sample.

    Args:
        trace: After how many steps each sample arrives, -1 for a lost one, shape (k,).
        send_period: Steps between samples.
        steps: How many.
    """
    stamps = np.arange(0, steps, send_period)
    delays = np.resize(trace, len(stamps))
    arrivals = stamps + delays
    counts = (delays >= 0) & (arrivals < steps)
    newest = np.zeros(steps, np.int64)
    np.maximum.at(newest, arrivals[counts], stamps[counts])
    return np.arange(steps) - np.maximum.accumulate(newest)


def _longest_run(trace: tuple[int, ...]) -> int:
    """Returns the longest run of lost packets in a trace that begins again at its end."""
    longest = run = 0
    for delay in trace + trace:
        run = run + 1 if delay < 0 else 0
        longest = max(longest, run)
    return longest


class UnusedPacketsWarning(UserWarning):
    """Packets arrive that no estimate uses."""


class DiscardedPackets(NamedTuple):
    """How many packets of an episode were discarded: too late, stamped ahead, or of another episode."""

    too_late: int = 0
    ahead: int = 0
    other_episode: int = 0

    def with_those_of(self, packets: Iterable[Packet], step: int, episode: int, longest_delay: int) -> DiscardedPackets:
        """Returns the counts with those of the packets that arrive at a step of an episode."""
        too_late, ahead, other_episode = self
        for packet in packets:
            if packet.episode != episode:
                other_episode += 1
            elif packet.stamp > step:
                ahead += 1
            elif step - packet.stamp > longest_delay:
                too_late += 1
        return DiscardedPackets(too_late, ahead, other_episode)


def as_packet(value: Any, size: int) -> Packet:
    """Returns a packet with a measurement of its own, shape (size,), which may be given as a number if size = 1.

    Raises:
        ValueError: If stamp or episode is no whole number, or the measurement is not numbers of that shape.
    """
    stamp = episode = 0
    try:
        stamp, measurement, episode = value if isinstance(value, Packet) else Packet(*value)
        stamp, episode, numbers = index(stamp), index(episode), as_numbers(measurement)
    except (TypeError, ValueError):
        numbers = None
    if numbers is not None and numbers.ndim == 0:
        numbers = numbers.reshape(1)
    if numbers is None or numbers.shape != (size,):
        raise ValueError(
            f"a packet is Packet(stamp, measurement) or Packet(stamp, measurement, episode) with whole numbers and a "
            f"measurement of shape ({size},), got {shown(value)}"
        )
    return Packet(stamp, np.array(numbers), episode)


class BrokenContractWarning(UserWarning):
    """The channels cannot keep the contract that a certificate assumes, so that its guarantee is likely to be lost."""


@dataclass(frozen=True)
class ChannelContract(ReadOnlyArrays):
    """At every step the newest sample used is at most `max_age` steps old (docs/contracts.md).

    The first estimate counts as a sample at step 0. For an unstable plant an error bound exists only under such a
    promise; for a stable one it makes the bound smaller.

    Attributes:
        max_age: h, 0 to 1000 [steps].
        quantization_step: The coarsest rounding of a measurement, in the units of y.

    Raises:
        ValueError: If a value is out of range.
    """

    max_age: int
    quantization_step: float = 0.0

    def __post_init__(self) -> None:
        self._check(as_count, "max_age", low=0, high=MAX_AGE)
        self._check(as_number, "quantization_step", low=0.0)

    def follows_from(self, other: ChannelContract | None) -> bool:
        """Returns whether whatever keeps another contract keeps this one, too."""
        if other is None:
            return False
        return other.max_age <= self.max_age and other.quantization_step <= self.quantization_step

    def is_kept_by(self, channel: Channel) -> bool:
        """Returns whether a channel can never break this contract."""
        return self.follows_from(contract_of(channel))

    def is_fine_enough_for(self, channel: Channel) -> bool:
        """Returns whether a channel rounds no more coarsely than promised."""
        return channel.quantization_step <= self.quantization_step


def contract_of(channel: Channel) -> ChannelContract | None:
    """Returns the contract that a channel keeps by its settings; None if its age has no limit or exceeds `MAX_AGE`."""
    age = channel.oldest_age
    return None if age is None or age > MAX_AGE else ChannelContract(age, channel.quantization_step)


@overload
def largest_age(contract: ChannelContract | None, without: int) -> int: ...


@overload
def largest_age(contract: ChannelContract | None, without: float = inf) -> float: ...


def largest_age(contract: ChannelContract | None, without: float = inf) -> float:
    """Returns the largest age of the newest sample that a contract allows; without one, another number [steps]."""
    return without if contract is None else contract.max_age


def warn_of_broken_contract(
    contract: ChannelContract | None,
    channel: Channel,
    input_delay: int,
    *,
    counts_losses: bool = False,
) -> None:
    """Warns the caller if a channel cannot keep the contract that a certificate assumes.

    Args:
        contract: That of the certificate; None for none.
        channel: The channel of the samples.
        input_delay: c, the number of steps from a decision to its effect.
        counts_losses: Whether losses and jitter count, as of a real channel. Without them it is warned only of what
            breaks the contract although no packet is lost, rounding included.
    """
    if contract is None:
        return
    if counts_losses and channel.most_consecutive_losses is None:
        warn_caller(
            "the channel may lose any number of packets in a row, but the certificate's contract allows the newest "
            f"sample to be {counted(contract.max_age, 'step')} old in all, so that the guarantee is likely to be "
            "lost",
            BrokenContractWarning,
        )
        return
    kept = contract_of(channel)
    age = kept.max_age if counts_losses and kept is not None else channel.send_period - 1 + channel.delay
    broken = []
    if age + input_delay > contract.max_age:
        later = f", and what is decided takes effect {counted(input_delay, 'step')} later" if input_delay else ""
        allowed = f"but the certificate's contract allows {counted(contract.max_age, 'step')} in all"
        broken.append(f"lets the newest sample become {counted(age, 'step')} old{later}, {allowed}")
    if not contract.is_fine_enough_for(channel):
        allowed = f"but the certificate's contract allows {contract.quantization_step:g}"
        broken.append(f"rounds measurements to {channel.quantization_step:g}, {allowed}")
    if not broken:
        return
    warn_caller(
        f"the channel {', and it '.join(broken)}, so that the guarantee is likely to be lost", BrokenContractWarning
    )
