"""A bad network in user space: between the nodes of a control loop it does to datagrams what networks do."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

import numpy as np

from ncs_gym import Channel
from ncs_gym.network.packet_loss_and_delay import first_loss_state, transmit

# A datagram that is to be used j steps after it was sent is handed over within this part of the step before.
EARLIEST, LATEST = 0.02, 0.3
# Datagrams that an attacker remembers.
RECORDED = 1000


class Line(asyncio.DatagramProtocol):
    """A socket that hands every datagram on as soon as it arrives, through an impairment."""

    def __init__(self) -> None:
        self.socket: Any = None
        self.sender: Any = None
        self.hand_on: Any = None

    def connection_made(self, transport: Any) -> None:
        """Is called by asyncio."""
        self.socket = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Is called by asyncio."""
        self.sender = addr
        if self.hand_on is not None:
            self.hand_on(data)

    def error_received(self, exc: Exception) -> None:
        """Is called by asyncio: nobody listens yet."""

    def send(self, data: bytes, to: Any = None) -> None:
        """Sends to whom it is connected with, or to whom it last heard."""
        if not self.socket.is_closing():
            self.socket.sendto(data, to)


class Impairment:
    """One direction between two sockets: loses, delays, reorders, duplicates, corrupts, replays and forges datagrams.

    Losses, bursts and delays are those of a channel, drawn by the function that simulations use. Of the lost ones some
    arrive with a bit that is turned over; duplicates, recordings of earlier datagrams and noise come on top.

    Args:
        channel: Loses and delays; a datagram that is j steps late arrives between steps j-1 and j.
        dt: Duration of a step [s].
        rng: Source of randomness.
        mischief: Share of lost datagrams that arrive corrupted, and probability that a datagram arrives twice, that an
            old one is replayed and that noise is sent.
        until_worst: Lose all that may be lost in a row, whenever the channel begins to lose.
    """

    def __init__(
        self, channel: Channel, dt: float, rng: np.random.Generator, mischief: float, until_worst: bool
    ) -> None:
        self._channel, self._dt, self._rng, self._mischief = channel, dt, rng, mischief
        self._state, self._is_worst = first_loss_state(channel, rng), until_worst
        self._recorded: list[bytes] = []
        self.counts: Counter[str] = Counter()

    def forward(self, data: bytes, receiver: Line, to: Any = None) -> None:
        """Takes a datagram, and sends to the receiver, now or later, what becomes of it."""
        rng = self._rng
        before = self._state.consecutive
        state, steps = transmit(self._channel, rng, self._state, sends=True)
        most = self._channel.max_consecutive_losses
        if self._is_worst and most is not None and 0 < before < most:  # a run that began is carried to its end
            state, steps = state._replace(consecutive=before + 1), -1
        self._state = state
        self.counts["sent"] += 1
        if steps < 0:
            self.counts["lost"] += 1
            if rng.random() < self._mischief:
                self._later(_corrupted(data, rng), 1, receiver, to, "corrupted")
        else:
            self._later(data, int(steps), receiver, to, "delivered")
            if rng.random() < self._mischief:
                self._later(data, int(steps + rng.integers(1, 5)), receiver, to, "duplicated")
        if rng.random() < self._mischief:
            if self._recorded:
                self._later(self._recorded[rng.integers(len(self._recorded))], 1, receiver, to, "replayed")
            self._later(rng.bytes(int(rng.integers(0, 200))), 1, receiver, to, "forged")
        if len(self._recorded) < RECORDED:
            self._recorded.append(data)
        else:
            self._recorded[rng.integers(RECORDED)] = data

    def _later(self, data: bytes, steps: int, receiver: Line, to: Any, count: str) -> None:
        wait = (steps - 1 + self._rng.uniform(EARLIEST, LATEST)) * self._dt
        self.counts[count] += 1
        asyncio.get_running_loop().call_later(max(wait, 0.0), receiver.send, data, to)


def _corrupted(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    changed[rng.integers(len(changed))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


async def open_line(
    front: tuple[str, int], back: tuple[str, int], up: Impairment, down: Impairment
) -> tuple[Line, Line]:
    """Opens the way between a node, which sends to `front`, and a controller at `back`."""
    loop = asyncio.get_running_loop()
    _, near = await loop.create_datagram_endpoint(Line, local_addr=front)
    _, far = await loop.create_datagram_endpoint(Line, remote_addr=back)
    near.hand_on = lambda data: up.forward(data, far)
    far.hand_on = lambda data: near.sender is not None and down.forward(data, near, near.sender)
    return near, far
