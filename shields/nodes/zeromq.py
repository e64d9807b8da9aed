"""Datagrams over ZeroMQ (extra [zmq]): the same interface as over UDP, for who has its sockets already."""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import suppress
from typing import Any

import zmq
import zmq.asyncio

from shields.nodes.transport import MOST_WAITING, Datagram


class ZmqTransport:
    """A ROUTER socket for the controller, a DEALER socket for sensor and actuator; made where an event loop runs.

    A message that cannot be sent at once is lost, as a datagram is: nothing is kept for a peer that comes later.

    Args:
        bind: Address at which a controller is heard, such as "tcp://*:47600"; empty for a sensor or an actuator.
        connect: Address of the controller; empty for the controller.

    Raises:
        ValueError: If both or none of them is given.
        zmq.ZMQError: If the address cannot be used.
    """

    def __init__(self, *, bind: str = "", connect: str = "") -> None:
        if bool(bind) == bool(connect):
            raise ValueError("give bind for the controller, or connect for a sensor or an actuator")
        self._is_router = bool(bind)
        self._context = zmq.asyncio.Context()
        self._socket = self._context.socket(zmq.ROUTER if self._is_router else zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.IMMEDIATE, 1)
        self._socket.setsockopt(zmq.SNDHWM, MOST_WAITING)
        self._socket.setsockopt(zmq.RCVHWM, MOST_WAITING)
        if bind:
            self._socket.bind(bind)
        else:
            self._socket.connect(connect)
        self._sender = zmq.Socket.shadow(self._socket)  # sends without a coroutine
        self._waiting: deque[Datagram] = deque(maxlen=MOST_WAITING)
        self._reading = asyncio.get_running_loop().create_task(self._read())

    async def _read(self) -> None:
        while True:
            *sender, data = await self._socket.recv_multipart()
            time = asyncio.get_running_loop().time()
            self._waiting.append(Datagram(time, data, sender[0] if sender else None))

    def send(self, data: bytes, to: Any = None) -> None:
        """Sends a message."""
        with suppress(zmq.ZMQError):  # nobody is there
            self._sender.send_multipart([to, data] if self._is_router else [data], zmq.NOBLOCK)

    def received(self) -> list[Datagram]:
        """Returns what arrived since the last call."""
        arrived = list(self._waiting)
        self._waiting.clear()
        return arrived

    def close(self) -> None:
        """Closes the socket."""
        self._reading.cancel()
        self._context.destroy(0)
