"""Datagrams: what is encoded is decoded, and nothing else is understood, whatever the bytes."""

import hashlib
import hmac
import pickle
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ncs_gym import batch_reactor, cart_pole
from ncs_gym.network.wire import MAGIC, TAG_SIZE, Kind, Message, Wire, WireError
from tests.fuzz import examples

PLANT, KEY = batch_reactor(), b"sixteen bytes or more"
WIRE = Wire(PLANT, 3, KEY)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
COUNTS = st.integers(0, 2**62 - 1)
FIELDS = {"episode": st.integers(0, 2**64 - 1), "stamp": COUNTS, "challenge": st.integers(0, 2**64 - 1)}


def values(count):
    return st.lists(NUMBERS, min_size=count, max_size=count)


MESSAGES = st.one_of(
    st.builds(Message, kind=st.just(Kind.SAMPLE), values=values(2).map(np.array), **FIELDS),
    st.builds(Message, kind=st.just(Kind.COMMAND), values=values(8).map(lambda v: np.reshape(v, (4, 2))), **FIELDS),
    st.builds(Message, kind=st.just(Kind.ECHO), missing=COUNTS, digest=st.binary(min_size=16, max_size=16), **FIELDS),
    st.builds(Message, kind=st.just(Kind.BEACON), requests=st.tuples(*[st.booleans()] * 4), **FIELDS),
)


def shown(message):
    fields = vars(message).copy()
    given = fields.pop("values")
    return fields, [] if given is None else np.asarray(given).tolist()


def reason_of(data, wire=WIRE):
    with pytest.raises(WireError) as refused:
        wire.decode(data)
    return refused.value.reason


@examples(40)
@given(MESSAGES)
def test_what_is_encoded_is_decoded(message):
    assert shown(WIRE.decode(WIRE.encode(message))) == shown(message)


@given(MESSAGES, st.data())
@examples(60)
def test_one_bit_more_or_less_or_another_is_refused(message, data):
    sent = WIRE.encode(message)
    changed = bytearray(sent)
    changed[data.draw(st.integers(0, len(sent) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    assert reason_of(bytes(changed)) in {"format", "length", "tag"}
    assert reason_of(sent[: data.draw(st.integers(0, len(sent) - 1))]) in {"format", "length", "tag"}
    assert reason_of(sent + b"\0") == "length"


@given(st.binary(max_size=300))
@examples(100)
def test_noise_is_refused(noise):
    assert reason_of(noise) in {"format", "length", "tag"}
    assert reason_of(MAGIC + b"\3\1\0\0" + noise) in {"length", "tag"}


def tagged(head):
    """What the documented tag makes a datagram of."""
    return head + hmac.new(KEY, head, hashlib.sha256).digest()[:TAG_SIZE]


def test_what_has_the_key_and_another_plant_version_or_size_is_refused():
    sample = Message(kind=Kind.SAMPLE, episode=1, stamp=2, values=np.zeros(2))
    data = WIRE.encode(sample)
    other = Wire(cart_pole(), 3, KEY).encode(Message(kind=Kind.BEACON, episode=1, stamp=2, requests=(True,) * 4))
    assert reason_of(other) == "plant"
    assert reason_of(Wire(PLANT, 3, KEY + b"!").encode(sample)) == "tag"
    for place, value in [(4, 2), (4, 4), (5, 0), (5, 5), (6, 1)]:
        head = bytearray(data[:-TAG_SIZE])
        head[place] = value
        assert reason_of(tagged(bytes(head))) == "format"
    command = Wire(PLANT, 4, KEY).encode(Message(kind=Kind.COMMAND, episode=1, stamp=2, values=np.zeros((5, 2))))
    assert reason_of(command) == "length"
    for place, text in (
        (24, struct.pack("<Q", 2**62)),
        (40, struct.pack("<d", np.nan)),
        (40, struct.pack("<d", np.inf)),
    ):
        head = bytearray(
            WIRE.encode(Message(kind=Kind.COMMAND, episode=1, stamp=2, values=np.zeros((4, 2))))[:-TAG_SIZE]
        )
        head[place : place + 8] = text
        assert reason_of(tagged(bytes(head))) == "value"
    beacon = WIRE.encode(Message(kind=Kind.BEACON, episode=1, stamp=2, requests=(True,) * 4))
    assert reason_of(tagged(beacon[: -TAG_SIZE - 1] + b"\2")) == "value"


def test_layout_is_the_documented_one():
    """Written down by hand: another language has to come to the same bytes."""
    data = WIRE.encode(Message(kind=Kind.SAMPLE, episode=7, stamp=9, challenge=11, values=np.array([1.5, -2.0])))
    head = (
        b"NCSW"
        + bytes([3, 1, 0, 0])
        + bytes.fromhex(PLANT.fingerprint)[:8]
        + struct.pack("<QQQdd", 7, 9, 11, 1.5, -2.0)
    )
    assert data == tagged(head)
    data = WIRE.encode(Message(kind=Kind.BEACON, episode=7, stamp=9, challenge=11, requests=(True, False, False, True)))
    head = b"NCSW" + bytes([3, 4, 0, 0]) + bytes.fromhex(PLANT.fingerprint)[:8]
    head += struct.pack("<QQQ", 7, 9, 11) + bytes([1, 0, 0, 1])
    assert data == tagged(head)
    assert TAG_SIZE == 16


def test_nothing_is_unpickled():
    assert reason_of(pickle.dumps(Message(kind=Kind.BEACON, episode=1, stamp=2, requests=(True,) * 4))) == "format"


def test_keys_have_sixteen_bytes_at_least():
    sample = Message(kind=Kind.ECHO, episode=1, stamp=2, challenge=3, missing=0, digest=bytes(16))
    assert shown(Wire(PLANT, 3, bytes(16)).decode(Wire(PLANT, 3, bytes(16)).encode(sample))) == shown(sample)
    with pytest.raises(ValueError, match="the key must be at least 16 bytes"):
        Wire(PLANT, 3, bytes(15))
