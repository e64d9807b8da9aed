"""What carries datagrams between the nodes of a control loop."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any, NamedTuple, Protocol

from ncs_gym.network.wire import LARGEST_DATAGRAM

# More than a node can have missed; beyond it the oldest are dropped, so that a flood takes no memory.
MOST_WAITING = 512


class Datagram(NamedTuple):
    """What arrived.

    Attributes:
        time: When, by the clock of the event loop [s].
        data: Its bytes.
        sender: Where an answer is sent to; hashable.
    """

    time: float
    data: bytes
    sender: Any


class Transport(Protocol):
    """Carries datagrams, each whole or not at all, in any order and any number of times.

    A node sends at its steps, and takes at the beginning of a step all that arrived since the last one.
    """

    def send(self, data: bytes, to: Any = None) -> None:
        """Sends a datagram to a sender, or to the peer that was given; what cannot be sent is lost."""
        ...

    def received(self) -> list[Datagram]:
        """Returns what arrived since the last call, in the order of arrival."""
        ...

    def close(self) -> None:
        """Sends and receives nothing any more."""
        ...


class UdpTransport(asyncio.DatagramProtocol):
    """Datagrams over UDP; made by `open`."""

    def __init__(self) -> None:
        self._waiting: deque[Datagram] = deque(maxlen=MOST_WAITING)
        self._socket: asyncio.DatagramTransport | None = None

    @classmethod
    async def open(cls, local: tuple[str, int] | None = None, peer: tuple[str, int] | None = None) -> UdpTransport:
        """Returns a transport that is bound to a local address, or talks with one peer only, or both.

        Raises:
            OSError: If the address is in use or there is none such.
        """
        loop = asyncio.get_running_loop()
        _, transport = await loop.create_datagram_endpoint(cls, local_addr=local, remote_addr=peer)
        return transport

    @property
    def address(self) -> tuple[str, int]:
        """The local address."""
        assert self._socket is not None
        return self._socket.get_extra_info("sockname")[:2]

    def connection_made(self, transport: Any) -> None:
        """Is called by asyncio."""
        self._socket = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Is called by asyncio; of a datagram that is too long for the loop one byte too many is kept."""
        time = asyncio.get_running_loop().time()
        self._waiting.append(Datagram(time, data[: LARGEST_DATAGRAM + 1], addr))

    def error_received(self, exc: Exception) -> None:
        """Is called by asyncio: nobody listens at the other end, so that what was sent is lost."""

    def send(self, data: bytes, to: Any = None) -> None:
        """Sends a datagram."""
        if self._socket is not None and not self._socket.is_closing():
            self._socket.sendto(data, to)

    def received(self) -> list[Datagram]:
        """Returns what arrived since the last call."""
        arrived = list(self._waiting)
        self._waiting.clear()
        return arrived

    def close(self) -> None:
        """Closes the socket."""
        if self._socket is not None:
            self._socket.close()
