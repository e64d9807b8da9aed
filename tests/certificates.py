"""Certificates that many tests share; tests of the synthesis itself call `synthesize`."""

from __future__ import annotations

from ncs_gym import ChannelContract, LinearPlant
from shields import Certificate, synthesize

_certificates: dict[tuple[str, ChannelContract | None], Certificate] = {}


def certificate_of(plant: LinearPlant, contract: ChannelContract | None = None) -> Certificate:
    """The certificate of a plant under a contract, synthesized once per process."""
    key = plant.fingerprint, contract
    if key not in _certificates:
        _certificates[key] = synthesize(plant, contract=contract)
    return _certificates[key]
