"""Certificates that many tests share; tests of the synthesis itself call `synthesize`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

from ncs_gym import ChannelContract, LinearPlant
from shields import Certificate, synthesize
from shields.verification import require_valid

_certificates: dict[tuple[str, ChannelContract | None], Certificate] = {}
_made_once: Callable[[str, Callable[[Path], None]], Path] | None = None


def share_between_workers(made_once: Callable[[str, Callable[[Path], None]], Path]) -> None:
    """Lets workers read the certificates that another worker of this run of the suite has synthesized."""
    global _made_once
    _made_once = made_once


def certificate_of(plant: LinearPlant, contract: ChannelContract | None = None) -> Certificate:
    """The certificate of a plant under a contract, synthesized once per run of the suite."""
    key = plant.fingerprint, contract
    if key not in _certificates:
        _certificates[key] = _read_or_synthesized(plant, contract)
    return _certificates[key]


def _read_or_synthesized(plant: LinearPlant, contract: ChannelContract | None) -> Certificate:
    if _made_once is None:
        return synthesize(plant, contract=contract)
    name = hashlib.sha256(f"{plant.fingerprint} {contract}".encode()).hexdigest()[:16]
    folder = _made_once(
        f"certificate-{name}", lambda folder: synthesize(plant, contract=contract).save(folder / "certificate.json")
    )
    return Certificate.load(folder / "certificate.json")


@cache
def require_valid_once(certificate: Certificate, plant: LinearPlant) -> None:
    """Raises unless a certificate verifies for a plant; the same objects, which cannot change, are verified once."""
    require_valid(certificate, plant)
