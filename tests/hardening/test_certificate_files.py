"""Certificate files damaged at every byte, and forged with a checksum that fits."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shields import Certificate, CertificateError
from shields.documents import digest
from tests.certificates import certificate_of
from tests.fuzz import examples
from tests.plants import named
from tests.verdicts import assert_true, verified

STEP = 17
CASES = ["stable", "unstable"]
KINDS = ["flip", "delete", "insert", "high bit", "digit", "truncate"]
REPLACEMENTS = [None, True, "0.5", "", [], {}, [[1.0]], float("nan"), float("inf"), 0, 0.0, -1, 1e300, 5e-324, 10**400]


def case(name):
    plant, contract = named(name)
    return plant, certificate_of(plant, contract)


def damaged(data, at, kind):
    byte = data[at]
    changed = {
        "flip": bytes([byte ^ (1 << at % 7)]),
        "high bit": bytes([byte ^ 0x80]),
        "delete": b"",
        "insert": bytes([byte, byte]),
        "digit": bytes([byte ^ 1]) if chr(byte).isdigit() else b"0",
        "truncate": b"",
    }[kind]
    return data[:at] + changed + (b"" if kind == "truncate" else data[at + 1 :])


def loaded_from(path):
    """The certificate in a file; None if it is refused in one sentence."""
    try:
        return Certificate.load(path)
    except CertificateError as error:
        sentence = str(error)
    assert "\n" not in sentence
    return None


def assert_noticed(data, certificate, path):
    """A damaged file is refused in one sentence, or says exactly the same."""
    path.write_bytes(data)
    loaded = loaded_from(path)
    assert loaded is None or loaded.document == certificate.document
    return loaded is None


@pytest.mark.parametrize("name", CASES)
def test_damage_at_any_byte_is_noticed(name, tmp_path):
    certificate, path = case(name)[1], tmp_path / "c.json"
    certificate.save(path)
    data = path.read_bytes()
    assert not assert_noticed(data, certificate, path)
    kinds = [(at, KINDS[at // STEP % len(KINDS)]) for at in range(0, len(data), STEP)]
    refused = sum(assert_noticed(damaged(data, at, kind), certificate, path) for at, kind in kinds)
    assert refused > 0.5 * len(kinds)  # what may change unnoticed is white space: most of the file is none


def leaves(value, path=()):
    """Paths of everything that is no container."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [leaf for key, each in items for leaf in leaves(each, (*path, key))]
    return [path]


def changed(content, path, change):
    """A copy of a certificate's content in which one entry is another."""
    copy = json.loads(json.dumps(content))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = change(inner[path[-1]])
    return copy


def forged(content, path):
    """The certificate in a file with a fitting checksum; None if it is refused."""
    text = json.dumps(content)
    literal = json.loads(text, parse_float=str, parse_int=str)
    path.write_text(json.dumps({"format": "ncs-gym certificate 5", "sha256": digest(literal), "certificate": content}))
    return loaded_from(path)


def judged(content, plant, path):
    """Whether a forged certificate is loaded and verifies; what verifies must be true."""
    certificate = forged(content, path)
    if certificate is None or not verified(certificate, plant).valid:
        return False
    assert_true(certificate, plant)
    return True


@given(data=st.data())
@examples(30)
def test_certificates_forged_at_random_are_refused_or_true(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "forged.json"
    plant, certificate = case(data.draw(st.sampled_from(CASES)))
    content = json.loads(json.dumps(certificate.document["certificate"]))
    for _ in range(data.draw(st.integers(1, 3))):
        places = leaves(content)
        containers = sorted({leaf[:depth] for leaf in places for depth in range(1, len(leaf))}, key=str)
        leaf = data.draw(st.sampled_from(places + containers))
        replacement = data.draw(st.sampled_from(REPLACEMENTS) | st.floats(allow_nan=True) | st.integers())
        content = changed(content, leaf, lambda value, new=replacement: new)
        if not leaves(content):
            break
    judged(content, plant, path)
