"""What a channel remembers during an episode: its loss process and the packets on their way."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym.network.channel import Channel, GilbertElliott, Packet

# More losses in a row than any episode has steps.
UNLIMITED = 2**31 - 1


class LossState(NamedTuple):
    """The loss process of one channel (numbers) or of N (arrays of shape (N,)).

    Attributes:
        bad: Whether the Gilbert-Elliott chain is in its bad state.
        consecutive: Number of packets that were lost in a row so far.
    """

    bad: Any
    consecutive: Any


def first_loss_state(channel: Channel, rng: np.random.Generator, size: int | None = None) -> LossState:
    """Returns the loss process at the start of an episode; a chain starts in its stationary distribution."""
    bad = False if size is None else np.zeros(size, np.bool_)
    if isinstance(channel.loss, GilbertElliott):
        bad = rng.random(size) < channel.loss.stationary_bad
    return LossState(bad, 0 if size is None else np.zeros(size, np.int64))


def transmit(channel: Channel, rng: np.random.Generator, state: LossState, sends: Any) -> tuple[LossState, Any]:
    """Moves the loss process one step on and sends a packet; the same text for one channel and for N.

    Args:
        channel: The settings.
        rng: Source of randomness.
        state: The loss process before the step.
        sends: Whether a packet is sent at this step, a bool or shape (N,).

    Returns:
        The loss process after the step, and after how many steps the packet arrives: -1 if never.
    """
    size = sends.shape if isinstance(sends, np.ndarray) else None
    bad, consecutive = state
    loss: Any = channel.loss
    if isinstance(loss, GilbertElliott):
        bad = bad != (rng.random(size) < loss.p_good_to_bad + (loss.p_bad_to_good - loss.p_good_to_bad) * bad)
        loss = loss.loss_good + (loss.loss_bad - loss.loss_good) * bad
        state = LossState(bad, consecutive)
    if not (sends if size is None else sends.any()):
        return state, -1 if size is None else np.full(size, -1)
    most = channel.max_consecutive_losses
    lost = sends * (rng.random(size) < loss) * (consecutive < (UNLIMITED if most is None else most))
    arrives = sends * (1 - lost)
    delay: Any = channel.delay
    if channel.jitter:
        delay = delay + rng.random(size) * (channel.jitter + 1) // 1
    return LossState(bad, (consecutive + lost) * (1 - arrives)), arrives * (delay + 1) - 1


class ChannelState:
    """One channel during one episode.

    Args:
        channel: The settings.
        rng: Draws the first state of a Gilbert-Elliott chain.

    Attributes:
        in_flight: The packets on their way, by the step at which they arrive.
    """

    def __init__(self, channel: Channel, rng: np.random.Generator) -> None:
        self.channel = channel
        self.in_flight: dict[int, list[Any]] = {}
        self._loss_state = first_loss_state(channel, rng)

    def sends_at(self, step: int) -> bool:
        """Returns whether the sensor sends at this step."""
        return step % self.channel.send_period == 0

    def exchange(
        self, rng: np.random.Generator, step: int, measurement: np.ndarray | None, episode: int = 0
    ) -> list[Packet]:
        """Puts a sample on the channel and takes off what arrives.

        Args:
            rng: Source of randomness; how much is drawn does not depend on the measurement.
            step: The current step.
            measurement: y, shape (p,), to be quantized, stamped and sent; None where `sends_at` is False.
            episode: Number of the estimator's episode, which the packet carries.

        Returns:
            The packets that arrive at this step, in the order in which they were sent.
        """
        self._loss_state, delay = transmit(self.channel, rng, self._loss_state, measurement is not None)
        if delay >= 0 and measurement is not None:
            packet = Packet(step, self.channel.quantize(measurement), episode)
            self.in_flight.setdefault(step + int(delay), []).append(packet)
        return self.in_flight.pop(step, [])

    def carry(self, rng: np.random.Generator, step: int, packet: Any) -> list[Any]:
        """Puts a packet of any kind on the channel as it is, and returns those that arrive at this step."""
        self._loss_state, delay = transmit(self.channel, rng, self._loss_state, sends=True)
        if delay >= 0:
            self.in_flight.setdefault(step + int(delay), []).append(packet)
        return self.in_flight.pop(step, [])


class VectorChannelState:
    """The channels of N environments.

    Args:
        channel: The settings.
        rng: Draws the first states of Gilbert-Elliott chains.
        size: N.
    """

    def __init__(self, channel: Channel, rng: np.random.Generator, size: int) -> None:
        self.channel, self._size = channel, size
        self._loss_state = first_loss_state(channel, rng, size)
        # For the samples of each age, after how many steps they arrive.
        self._delays = [np.full(size, -1) for _ in range(channel.longest_delay + 1)]

    def begin(self, rng: np.random.Generator, chosen: Any) -> None:
        """Starts episodes in some environments; what is on its way there never arrives."""
        count = np.arange(self._size)[chosen].size
        for kept, first in zip(self._loss_state, first_loss_state(self.channel, rng, count), strict=True):
            kept[chosen] = first
        for delays in self._delays:
            delays[chosen] = -1

    def send(self, rng: np.random.Generator, steps: np.ndarray) -> np.ndarray:
        """Sends samples where it is time, at steps (N,) of the episodes; returns which environments send, (N,)."""
        sends = steps % self.channel.send_period == 0
        self._loss_state, delays = transmit(self.channel, rng, self._loss_state, sends)
        self._delays = [delays, *self._delays[:-1]]
        return sends

    def discard(self, chosen: Any) -> None:
        """Loses the samples that were just sent by some environments."""
        self._delays[0][chosen] = -1

    def arrivals(self) -> list[tuple[int, np.ndarray]]:
        """Returns the ages of the samples that arrive now, oldest first, each with the environments (N,)."""
        found = []
        for age in range(self.channel.longest_delay, self.channel.delay - 1, -1):
            arrives = self._delays[age] == age
            if arrives.any():
                found.append((age, arrives))
        return found
