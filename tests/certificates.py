"""Certificates that many tests share; tests of the synthesis itself call `synthesize`."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy._core._multiarray_umath import __cpu_features__

from ncs_gym import ChannelContract, LinearPlant
from shields import Certificate
from shields.packaged_certificates import certificate_of_package
from shields.polytope import Polytope
from tests.product import synthesize

ROOT = Path(__file__).resolve().parent.parent
# Those of named plants by their names, the others by `_name_of`.
CHECKED_IN = Path(__file__).resolve().parent / "data" / "certificates"
_certificates: dict[tuple[str, ChannelContract | None, str], Certificate] = {}
_kept: Callable[[str, Callable[[Path], None]], Path] | None = None


def source_digest() -> str:
    """What certificates of tests depend on: the source of both packages, the libraries, and the processor's kernels."""
    versions = map(version, ("numpy", "scipy", "cvxpy", "clarabel", "python-flint"))
    kernels = [
        os.environ.get(name) for name in ("OPENBLAS_CORETYPE", "OPENBLAS_NUM_THREADS", "NPY_DISABLE_CPU_FEATURES")
    ]
    digest = hashlib.sha256(repr([*versions, *kernels, sorted(__cpu_features__.items())]).encode())
    for path in sorted(path for package in ("ncs_gym", "shields") for path in (ROOT / package).rglob("*.py")):
        digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def keep_certificates(folder_of: Callable[[str, Callable[[Path], None]], Path]) -> None:
    """Lets this process read the certificates that another one has synthesized from the same source.

    Args:
        folder_of: Returns the folder of a name, filled by the given function if it is new.
    """
    global _kept
    _kept = folder_of


def certificate_of(
    plant: LinearPlant, contract: ChannelContract | None = None, safe_set: str = "ellipsoid"
) -> Certificate:
    """The certificate of a plant under a contract: checked in, or synthesized once for a state of the source.

    It is of a polytope where limits within a step leave no ellipsoid.
    """
    safe_set = "polytope" if len(plant.step_rows) else safe_set
    key = plant.fingerprint, contract, safe_set
    if key not in _certificates:
        _certificates[key] = _read_or_synthesized(plant, contract, safe_set)
    return _certificates[key]


def metric(certificate: Certificate) -> np.ndarray:
    """M of the set x'Mx <= 1 that a certificate keeps, or of an ellipsoid like its polytope."""
    S = certificate.safe_set
    return S.F.T @ S.F if isinstance(S, Polytope) else np.linalg.inv(S.shape_matrix)


def with_proof(certificate: Certificate, age: int = -1, **changes: Any) -> Certificate:
    """A certificate whose proof for an age of the newest sample, by default for the largest, has other fields."""
    proofs = list(certificate.proofs)
    proofs[age] = replace(proofs[age], **changes)
    return replace(certificate, proofs=tuple(proofs))


def _read_or_synthesized(plant: LinearPlant, contract: ChannelContract | None, safe_set: str) -> Certificate:
    known = certificate_of_package(plant, contract, safe_set) or _checked_in(plant, contract, safe_set)
    if known is not None:
        return known
    name = _name_of(plant, contract, safe_set)
    if (file := CHECKED_IN / "others" / f"{name}.json").exists():
        return Certificate.load(file)
    if _kept is None:
        return synthesize(plant, contract=contract, safe_set=safe_set)

    def fill(folder: Path) -> None:
        synthesize(plant, contract=contract, safe_set=safe_set).save(folder / "certificate.json")

    folder = _kept(f"certificate-{name}", fill)
    return Certificate.load(folder / "certificate.json")


def _name_of(plant: LinearPlant, contract: ChannelContract | None, safe_set: str) -> str:
    return hashlib.sha256(f"{plant.fingerprint} {contract} {safe_set}".encode()).hexdigest()[:16]


def _checked_in(plant: LinearPlant, contract: ChannelContract | None, safe_set: str) -> Certificate | None:
    for file in CHECKED_IN.glob("*.json"):
        is_asked = (".ellipsoid" in file.name) == (safe_set == "ellipsoid") and plant.fingerprint in file.read_text()
        if is_asked and (certificate := Certificate.load(file)).contract == contract:
            return certificate
    return None


def main() -> None:
    """Checks in what the tests had to synthesize: `python -m tests.certificates`, after a run on this source."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in `conftest.py`; the name of the folder depends on it
    for folder in (ROOT / ".pytest_cache" / "d" / f"certificates-{source_digest()}").glob("certificate-*/"):
        shutil.copy(folder / "certificate.json", CHECKED_IN / "others" / f"{folder.name.partition('-')[2]}.json")


if __name__ == "__main__":
    main()
