"""What a picture shows of the past: the recent path, and the fate of the recent packets."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from ncs_gym.network.channel import Packet
from ncs_gym.network.channel_state import ChannelState
from ncs_gym.rendering.annotation import Annotation

# Steps of the path and of the packet strip that are kept.
RECENT = 40


class Flight(NamedTuple):
    """A packet as the picture sees it.

    Attributes:
        stamp: The step it was sent at.
        arrival: The step it arrives at; None if it is lost.
    """

    stamp: int
    arrival: int | None


class Moment(NamedTuple):
    """The true state at one step, shape (n,), and whether the shield acted on the step that led there."""

    state: np.ndarray
    acted: bool


class History:
    """The recent past of one episode; filled at every step, drawn only when asked for."""

    def __init__(self) -> None:
        self._pending: Annotation | None = None
        self.begin(np.zeros(0))

    def begin(self, state: np.ndarray) -> None:
        """Starts an episode at a state, shape (n,)."""
        self.annotation, self._pending = self._pending, None
        self.moments = deque([Moment(state, False)], maxlen=RECENT)
        self.flights: deque[Flight] = deque(maxlen=RECENT)
        self.input: np.ndarray | None = None
        self.step, self.distance = 0, 0.0

    def annotate(self, annotation: Annotation) -> None:
        """Takes what is to be shown with the next step or reset."""
        self._pending = annotation

    def add(self, state: np.ndarray, u: np.ndarray, link: ChannelState, packets: list[Packet], driven: float) -> None:
        """Takes in a step.

        Args:
            state: Afterwards, shape (n,); not written to later.
            u: Input applied, shape (m,).
            link: The channel after the exchange of this step.
            packets: What arrived at this step.
            driven: Way covered in this step, if any [m].
        """
        self.step += 1
        self.distance += driven
        self.annotation, self._pending = self._pending, None
        acted = self.annotation is not None and self.annotation.intervened
        self.moments.append(Moment(state, acted))
        self.input = u
        if link.sends_at(self.step):
            self.flights.append(Flight(self.step, _arrival(self.step, link, packets)))


def _arrival(stamp: int, link: ChannelState, packets: list[Packet]) -> int | None:
    """Returns when the packet sent at this very step arrives; None if it was lost."""
    if any(packet.stamp == stamp for packet in packets):
        return stamp
    for step, flying in link.in_flight.items():
        if any(packet.stamp == stamp for packet in flying):
            return step
    return None
