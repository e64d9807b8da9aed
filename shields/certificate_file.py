"""The file format of certificates: JSON in which every float is exact, with a checksum of its content."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ncs_gym.estimation.error_bounds_by_age import ErrorSetsByAge
from ncs_gym.network.contract import ChannelContract
from ncs_gym.validation import as_setting
from shields.atomic_write import write_atomically
from shields.errors import CertificateError
from shields.proof_data import ContractProof, Multipliers

_FORMAT = "ncs-gym certificate 2"
# The arrays of the error sets by age: keys of the file, and the attributes of `ErrorSetsByAge` they stand for.
_SET_ARRAYS = {"shapes": "shapes", "rates": "rates", "gains": "gains", "shares": "multipliers", "noise": "noise"}


def document_of(fields: dict[str, Any]) -> dict[str, Any]:
    """Returns what the file of a certificate holds, given its fields by name, as JSON values."""
    content = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in fields.items()}
    if content["multipliers"] is not None:
        content["multipliers"] = asdict(content["multipliers"])
    if content["ages"] is not None:
        content["ages"] = _contract_proof_content(content["ages"])
    literal = json.loads(json.dumps(content), parse_float=str, parse_int=str)
    return {"format": _FORMAT, "sha256": _digest(literal), "certificate": content}


def write(path: str | os.PathLike[str], document: dict[str, Any]) -> None:
    """Writes the file of a certificate atomically.

    Raises:
        OSError: If the file cannot be written.
    """
    write_atomically(Path(path), json.dumps(document, indent=1) + "\n")


def read(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, Any]:
    """Returns the named fields of the certificate in a file, after comparing the file's checksum.

    Raises:
        CertificateError: If the file is missing, not a certificate, truncated or altered.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        document, literal = json.loads(text), json.loads(text, parse_float=str, parse_int=str)
    except (OSError, TypeError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or "it is not valid JSON"
        raise CertificateError(f"cannot read certificate {path}: {reason}") from error
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise CertificateError(f"{path} is not a certificate of format {_FORMAT!r}")
    try:
        if document["sha256"] != _digest(literal["certificate"]):
            raise CertificateError(f"certificate {path} was altered: its checksum does not match")
        return _fields(document["certificate"], names)
    except CertificateError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise CertificateError(f"{path} is not a certificate: an entry is missing or of a wrong kind") from error


def _fields(content: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Returns the named fields of a certificate from the content of its file."""
    fields = {name: content[name] for name in names}
    if fields["multipliers"] is not None:
        fields["multipliers"] = Multipliers(**fields["multipliers"])
    if fields["ages"] is not None:
        fields["ages"] = _contract_proof(fields["ages"])
    return fields


def _contract_proof_content(proof: ContractProof) -> dict[str, Any]:
    """Returns the JSON values of a proof by age."""
    return {
        "contract": asdict(proof.sets.contract),
        "sets": {key: getattr(proof.sets, name).tolist() for key, name in _SET_ARRAYS.items()},
        "shares": proof.multipliers.tolist(),
        "inputs": proof.inputs.tolist(),
    }


def _contract_proof(content: dict[str, Any]) -> ContractProof:
    """Returns the proof by age of a file's content."""
    given = {name: as_setting(content["sets"][key]) for key, name in _SET_ARRAYS.items()}
    arrays = {name: np.array(value, dtype=np.float64) for name, value in given.items()}
    sets = ErrorSetsByAge(contract=ChannelContract(**content["contract"]), **arrays)
    return ContractProof(sets=sets, multipliers=content["shares"], inputs=content["inputs"])


def _digest(literal: Any) -> str:
    """Returns the SHA-256 of a content whose numbers are their literal digits, whatever the white space."""
    return hashlib.sha256(json.dumps(literal, sort_keys=True).encode()).hexdigest()
