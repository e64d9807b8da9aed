"""What arrives at a receiver: packets as they are handed over, and counts of those that are of no use."""

from __future__ import annotations

from collections.abc import Iterable
from operator import index
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.network.channel import Packet
from ncs_gym.validation import as_numbers, shown


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
