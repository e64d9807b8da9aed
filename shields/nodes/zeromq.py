"""Datagrams over ZeroMQ (extra [zmq]): the same interface as over UDP, for who has its sockets already."""

from __future__ import annotations

import asyncio
import hmac
from collections import deque
from typing import Any

import zmq
import zmq.asyncio
from zmq.utils import z85

from ncs_gym.network.wire import LARGEST_DATAGRAM, require_key
from shields.nodes.transport import MOST_WAITING, Datagram

# What encryption adds to a message at most.
CURVE_OVERHEAD = 64


class ZmqTransport:
    """A ROUTER socket for the controller, a DEALER socket for sensor and actuator; made where an event loop runs.

    A message that cannot be sent at once is lost, as a datagram is: nothing is kept for a peer that comes later. Who
    does not have the key is not heard at all (CURVE, with keys that are derived from it): of a stranger even a message
    in very many parts would be kept. Longer messages than those of the loop end the connection that they come from.

    Args:
        key: What sensor, controller and actuator share, at least 16 bytes: that of the `Wire`.
        bind: Address at which a controller is heard, such as "tcp://*:47600"; empty for a sensor or an actuator.
        connect: Address of the controller; empty for the controller.

    Raises:
        ValueError: If both or none of them is given, or the key is too short.
        zmq.ZMQError: If the address cannot be used.
    """

    def __init__(self, key: bytes, *, bind: str = "", connect: str = "") -> None:
        if bool(bind) == bool(connect):
            raise ValueError("give bind for the controller, or connect for a sensor or an actuator")
        secret = z85.encode(hmac.digest(require_key(key), b"the controller's secret key of CURVE", "sha256"))
        self._is_router = bool(bind)
        self._context = zmq.asyncio.Context()
        self._socket = self._context.socket(zmq.ROUTER if self._is_router else zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.IMMEDIATE, 1)
        self._socket.setsockopt(zmq.SNDHWM, MOST_WAITING)
        self._socket.setsockopt(zmq.RCVHWM, MOST_WAITING)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_DATAGRAM + CURVE_OVERHEAD)
        if self._is_router:
            self._socket.curve_server, self._socket.curve_secretkey = True, secret
        else:
            self._socket.curve_serverkey = zmq.curve_public(secret)
            self._socket.curve_publickey, self._socket.curve_secretkey = zmq.curve_keypair()
        if bind:
            self._socket.bind(bind)
        else:
            self._socket.connect(connect)
        self._waiting: deque[Datagram] = deque(maxlen=MOST_WAITING)
        self._reading = asyncio.get_running_loop().create_task(self._read())

    async def _read(self) -> None:
        while True:
            *sender, data = await self._socket.recv_multipart()
            time = asyncio.get_running_loop().time()
            self._waiting.append(Datagram(time, data, sender[0] if self._is_router else None))

    def send(self, data: bytes, to: Any = None) -> None:
        """Sends a message."""
        sent = self._socket.send_multipart([to, data] if self._is_router else [data], zmq.NOBLOCK)
        sent.exception()  # nobody is there  # pyright: ignore[reportAttributeAccessIssue]

    def received(self) -> list[Datagram]:
        """Returns what arrived since the last call."""
        arrived = list(self._waiting)
        self._waiting.clear()
        return arrived

    def close(self) -> None:
        """Closes the socket."""
        self._reading.cancel()
        self._context.destroy(0)
