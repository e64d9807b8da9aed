"""The datagrams of a control loop: one fixed binary layout, authenticated with a shared key (docs/network_loop.md).

Every datagram is a header, a body whose length its kind fixes, and a tag, all numbers in little-endian order:

    offset  size  field
         0     4  magic, the letters NCSW
         4     1  version, 3
         5     1  kind: 1 sample, 2 command, 3 echo, 4 beacon
         6     2  zero
         8     8  the first 8 bytes of the plant's fingerprint
        16     8  episode: a random number that the controller draws at each start; 0 for none
        24     8  stamp: number of the step since the start of the episode, below 2^62
        32     8  challenge: a random number that a sensor or an actuator drew, and that the controller sends back
        40     .  body: the p values of a sample; the (c+1) m values of a command, step by step, as IEEE 754 doubles;
                  of an echo the number of missing inputs (8 bytes) and the digest of those applied (16); of a beacon
                  whether the samples of the c+1 steps after it are requested, one byte each, 1 or 0
         .    16  tag: the first 16 bytes of HMAC-SHA256 of all that comes before

Nothing is unpickled, nothing in a datagram says how much memory to take, and what is not exactly this is refused.
"""

from __future__ import annotations

import hmac
import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import as_count, shown

MAGIC, VERSION = b"NCSW", 3
# Where one datagram has to fit into one frame of a usual network.
LARGEST_BODY, SHORTEST_KEY, TAG_SIZE = 1400, 16, 16
LARGEST_STAMP = 2**62
_HEADER = struct.Struct("<4sBBH8sQQQ")
_ECHO = struct.Struct("<Q16s")
LARGEST_DATAGRAM = _HEADER.size + LARGEST_BODY + TAG_SIZE


class WireError(ValueError):
    """A datagram that is not one of this loop; `reason` is a word to count it by.

    Attributes:
        reason: "length", "format", "plant", "tag" or "value".
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason

    def __str__(self) -> str:
        return f"a datagram was refused: {self.reason}"


class Kind(IntEnum):
    """What a datagram is about: from the sensor, to the actuator, from the actuator, to the sensor."""

    SAMPLE = 1
    COMMAND = 2
    ECHO = 3
    BEACON = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class Message:
    """A datagram that is understood.

    Attributes:
        kind: What it is about.
        episode: Number that the controller drew for the episode; 0 for none.
        stamp: Step at which a sample was taken or a command decided; of an echo, how many steps it is about.
        challenge: The sender's own, or in messages of a controller the addressee's.
        values: Of a sample shape (p,), of a command (c+1, m), else empty.
        missing: Of an echo, how many inputs were missing.
        digest: Of an echo, the digest of the inputs applied.
        requests: Of a beacon, whether the samples of the c+1 steps after it are requested; all are where samples are
            not on request.
    """

    kind: Kind
    episode: int
    stamp: int
    challenge: int = 0
    values: np.ndarray | None = None
    missing: int = 0
    digest: bytes = b""
    requests: tuple[bool, ...] = ()


def require_key(key: bytes) -> bytes:
    """Returns a key.

    Raises:
        ValueError: If it is too short.
    """
    if not isinstance(key, bytes) or len(key) < SHORTEST_KEY:
        raise ValueError(f"the key must be at least {SHORTEST_KEY} bytes, as os.urandom(32) makes them")
    return key


class Wire:
    """Encodes and decodes the messages of one control loop.

    Args:
        plant: Gives sizes and fingerprint: what was sent for another plant is refused.
        input_delay: c, the number of steps from a decision to its effect.
        key: What sensor, controller and actuator share and nobody else knows, at least 16 bytes.

    Attributes:
        input_delay: c.

    Raises:
        ValueError: If the key is too short, or a command does not fit into one datagram.
    """

    def __init__(self, plant: LinearPlant, input_delay: int, key: bytes) -> None:
        self._key, self._fingerprint = require_key(key), bytes.fromhex(plant.fingerprint)[:8]
        self.input_delay = as_count(input_delay, "input_delay", low=0)
        shapes = {Kind.SAMPLE: (plant.p,), Kind.COMMAND: (self.input_delay + 1, plant.m)}
        self._shapes = shapes | {Kind.ECHO: (0,), Kind.BEACON: (0,)}
        sizes = {kind: 8 * int(np.prod(shape)) for kind, shape in self._shapes.items()}
        sizes |= {Kind.ECHO: _ECHO.size, Kind.BEACON: self.input_delay + 1}
        if max(sizes.values()) > LARGEST_BODY:
            raise ValueError(f"samples and commands of this plant take more than {LARGEST_BODY} bytes: {shapes}")
        self._lengths = {kind: _HEADER.size + size + TAG_SIZE for kind, size in sizes.items()}

    def encode(self, message: Message) -> bytes:
        """Returns a datagram.

        Raises:
            ValueError: If the message does not fit the plant.
        """
        kind = message.kind
        body = b""
        if kind is Kind.ECHO:
            body = _ECHO.pack(message.missing, message.digest)
        elif kind is Kind.BEACON:
            if len(message.requests) != self.input_delay + 1:
                raise ValueError(f"a beacon has {self.input_delay + 1} requests, got {shown(message.requests)}")
            body = bytes(message.requests)
        else:
            values = np.asarray(message.values, dtype="<f8")
            if values.shape != self._shapes[kind]:
                raise ValueError(f"values must have shape {self._shapes[kind]}, got {shown(message.values)}")
            body = values.tobytes()
        head = (MAGIC, VERSION, kind, 0, self._fingerprint, message.episode, message.stamp, message.challenge)
        data = _HEADER.pack(*head) + body
        return data + self._tag(data)

    def decode(self, data: bytes) -> Message:
        """Returns the message of a datagram.

        Raises:
            WireError: If it is none of this loop, whatever the bytes.
        """
        if len(data) < _HEADER.size + TAG_SIZE:
            raise WireError("length")
        magic, version, number, rest, fingerprint, episode, stamp, challenge = _HEADER.unpack_from(data)
        if magic != MAGIC or version != VERSION or rest or not Kind.SAMPLE <= number <= Kind.BEACON:
            raise WireError("format")
        kind = Kind(number)
        if len(data) != self._lengths[kind]:
            raise WireError("length")
        if not hmac.compare_digest(self._tag(data[:-TAG_SIZE]), data[-TAG_SIZE:]):
            raise WireError("tag")
        if fingerprint != self._fingerprint:
            raise WireError("plant")
        body, missing, digest, requests = data[_HEADER.size : -TAG_SIZE], 0, b"", b""
        if kind is Kind.ECHO:
            (missing, digest), body = _ECHO.unpack(body), b""
        elif kind is Kind.BEACON:
            requests, body = body, b""
        values = np.frombuffer(body, "<f8").astype(np.float64).reshape(self._shapes[kind])
        if (
            stamp >= LARGEST_STAMP
            or missing >= LARGEST_STAMP
            or (kind is Kind.COMMAND and not np.isfinite(values).all())
            or any(each > 1 for each in requests)
        ):
            raise WireError("value")
        fields = {"challenge": challenge, "values": values, "missing": missing, "digest": digest}
        return Message(kind=kind, episode=episode, stamp=stamp, requests=tuple(map(bool, requests)), **fields)

    def _tag(self, data: bytes) -> bytes:
        return hmac.digest(self._key, data, "sha256")[:TAG_SIZE]
