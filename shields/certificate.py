"""The certificate: an invariant set, its gain, and a list of proofs, one per error set; and its file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import ChannelContract, Ellipsoid
from ncs_gym.reading import read_text
from ncs_gym.validation import FILLED_IN_LATER, ReadOnlyArrays, as_matrix, as_setting, as_vector, read_only, shown
from shields.certificate_text import (
    contract_text,
    counted,
    provenance_rows,
    size_of,
    table,
)
from shields.documents import content_of, document_of, write_document
from shields.errors import CertificateError
from shields.polytope import Polytope, polytope_content, polytope_of

_FORMAT = "ncs-gym certificate 5"
# Parts of a point that are smaller than this share of the set are shown as zero.
_DUST = 1e-9
# Fields of a `Proof` with an ellipsoid, and those of `Updates` that are arrays.
_OF_ELLIPSOID, _OF_UPDATES = ("shares", "inputs"), ("last", "gains", "shares", "noise")


@dataclass(frozen=True, eq=False, kw_only=True)
class Proof(ReadOnlyArrays):
    """Why u = K x_hat keeps the state in S, and the input within its limits, for every estimation error in one set.

    Attributes:
        Sigma: Shape of the error set, (n, n).
        rate: Multiplier lam of (E1), in (0, 1), under a contract of (C1): with no sample the error is in the next set.
        shares: Of an ellipsoid: multipliers lx, le, ld > 0 of state, estimation error and disturbance in (I), at most 1
            together, shape (3,). None with a polytope, which has multipliers of its own.
        inputs: Of an ellipsoid: multipliers mu_i in (0, 1) of the input limits (U), shape (m,).
    """

    Sigma: np.ndarray
    rate: float
    shares: np.ndarray | None = None
    inputs: np.ndarray | None = None

    def __post_init__(self) -> None:
        try:
            rate = float(_as_array(self.rate, (), "the rate of an error set"))
            self._set(Sigma=as_matrix(self.Sigma, (None, None), "Sigma"), rate=rate)
            if (self.shares is None) != (self.inputs is None):
                raise ValueError("the multipliers of (I) and (U) must both be given, or neither")
            if self.shares is not None:
                shares = _as_array(self.shares, (3,), "the multipliers of (I)")
                self._set(shares=shares, inputs=_as_array(self.inputs, (None,), "the multipliers of (U)"))
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: {error}") from error


@dataclass(frozen=True, eq=False, kw_only=True)
class Updates(ReadOnlyArrays):
    """How samples lead estimation errors of every age back into the first error set: (C2) of docs/shield_proof.md.

    Attributes:
        contract: What the channel promises: the newest sample is at most h steps old.
        last: Shape of the set after that of the largest age, Sigma_{h+1}, (n, n).
        gains: Gains T_j of updates of errors in the sets 1..h+1, shape (h+1, n, p).
        shares: Multipliers mu_j of these updates, shape (h+1,).
        noise: N, the shape of the set of sensor noise and quantization error, (p, p).
    """

    contract: ChannelContract
    last: np.ndarray
    gains: np.ndarray
    shares: np.ndarray
    noise: np.ndarray

    def __post_init__(self) -> None:
        try:
            if not isinstance(self.contract, ChannelContract):
                raise ValueError("its contract is no ChannelContract")
            steps = self.contract.max_age + 1
            last, noise = as_matrix(self.last, (None, None), "last"), as_matrix(self.noise, (None, None), "noise")
            expected = {"gains": (steps, len(last), len(noise)), "shares": (steps,)}
            arrays = {name: _as_array(getattr(self, name), shape, name) for name, shape in expected.items()}
            if not np.isfinite(arrays["gains"]).all():
                raise ValueError("its gains must be finite")
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: {error}") from error
        self._set(**arrays, last=last, noise=noise)


class Fallback(NamedTuple):
    """The fallback input u = u_c + K (x_hat - x_c) of a certificate, K x_hat around the operating point.

    Attributes:
        gain: K, shape (m, n).
        resting_state: x_c, shape (n,).
        resting_input: u_c, shape (m,).
    """

    gain: np.ndarray
    resting_state: np.ndarray
    resting_input: np.ndarray

    @classmethod
    def of_gain(cls, gain: np.ndarray) -> Fallback:
        """Returns u = K x_hat of a gain K, shape (m, n)."""
        return cls(gain, *(np.zeros(size) for size in gain.shape[::-1]))

    @property
    def constant(self) -> np.ndarray:
        """u_c - K x_c, shape (m,), which K x_hat is added to."""
        return self.resting_input - self.gain @ self.resting_state


@dataclass(frozen=True, eq=False, kw_only=True)
class Certificate(ReadOnlyArrays):
    """A robust control invariant set S inside the safe box, its gain, and the numbers that prove it.

    It is not trusted until `shields.verify` has checked it in exact arithmetic. Two are equal if their files are, in
    every digit.

    Attributes:
        safe_set: S, which a shield keeps: an ellipsoid E(L) around zero, or a polytope around `resting_state`.
        K: Gain of the fallback input, shape (m, n) [input per state].
        proofs: Under a channel contract one for each age 0..h of the newest sample, otherwise a single one.
        D: Shape of the disturbance set that the proofs assume, (n, n).
        rounding: Of an ellipsoid: multiplier s > 0 of D_u, which is D enlarged by the rounding of actions to float32.
        updates: What a channel contract adds to the proofs; None without a contract.
        resting_state: x_c of the fallback input u = u_c + K (x_hat - x_c), shape (n,): an equilibrium without
            estimation error and disturbance; zero, the plant's operating point, by default.
        resting_input: u_c, shape (m,).
        fingerprint: That of the plant.
        provenance: How the certificate was made (solver, versions, volume); it proves nothing.
    """

    safe_set: Ellipsoid | Polytope
    K: np.ndarray
    proofs: tuple[Proof, ...]
    D: np.ndarray
    rounding: float | None = None
    updates: Updates | None = None
    resting_state: np.ndarray = FILLED_IN_LATER
    resting_input: np.ndarray = FILLED_IN_LATER
    fingerprint: str
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        try:
            self._check_fields()
            n = self.safe_set.dim
            self._set(K=as_matrix(self.K, (None, n), "K"), D=as_matrix(self.D, (n, n), "D"))
            if self.rounding is not None:
                self._set(rounding=float(_as_array(self.rounding, (), "rounding")))
            for name, size in (("resting_state", n), ("resting_input", len(self.K))):
                value = getattr(self, name)
                self._set(**{name: np.zeros(size) if value is None else as_vector(value, size, name)})
            self._set(proofs=tuple(self.proofs))
            self._check_error_sets(n)
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: {error}") from error

    def _check_fields(self) -> None:
        if not (isinstance(self.provenance, dict) and isinstance(self.fingerprint, str)):
            raise ValueError("its provenance must be a dict, and its fingerprint a text")
        if type(self.safe_set) not in (Ellipsoid, Polytope):
            raise ValueError("its safe set must be an Ellipsoid or a Polytope")
        if type(self.updates) not in (Updates, type(None)):
            raise ValueError("its updates must be of type Updates")

    def _check_error_sets(self, n: int) -> None:
        """Raises ValueError unless there is a proof for every age, and all error sets have n dimensions."""
        ages = 1 if self.updates is None else self.updates.contract.max_age + 1
        if len(self.proofs) != ages:
            raise ValueError(f"it must have {ages} proofs, one per error set, got {len(self.proofs)}")
        for Sigma in (*(proof.Sigma for proof in self.proofs), *self.next_error_shapes):
            as_matrix(Sigma, (n, n), "Sigma")
        S, of_ellipsoid = self.safe_set, [*(proof.shares for proof in self.proofs), self.rounding]
        if any((each is None) != isinstance(S, Polytope) for each in of_ellipsoid):
            raise ValueError("multipliers of (I) and of rounding belong to an ellipsoid, which needs all of them")
        if not np.array_equal(self.resting_state, S.center if isinstance(S, Polytope) else np.zeros(n)):
            raise ValueError("its safe set must be around its resting state")

    @property
    def fallback(self) -> Fallback:
        """The input that keeps the state in the safe set."""
        return Fallback(self.K, self.resting_state, self.resting_input)

    @property
    def contract(self) -> ChannelContract | None:
        """The channel contract that it assumes; None without one."""
        return None if self.updates is None else self.updates.contract

    @property
    def Sigma(self) -> np.ndarray:
        """Shape of the error set, (n, n); under a contract that of the largest age."""
        return self.proofs[-1].Sigma

    @cached_property
    def error_set(self) -> Ellipsoid:
        """The certified error set E(Sigma)."""
        return Ellipsoid(self.Sigma)

    @cached_property
    def error_shapes(self) -> np.ndarray:
        """Shapes of all error sets for which K x_hat keeps the state safe, (k, n, n)."""
        return read_only(np.array([proof.Sigma for proof in self.proofs]))

    @property
    def next_error_shapes(self) -> list[np.ndarray]:
        """Shapes of the sets in which errors of each proof's set are one step later, if no sample comes."""
        last = self.proofs[-1].Sigma if self.updates is None else self.updates.last
        return [*(proof.Sigma for proof in self.proofs[1:]), last]

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the content of the certificate's file."""
        return self.document["sha256"]

    @property
    def document(self) -> dict[str, Any]:
        """The content of the certificate's file as JSON values."""
        return document_of("certificate", _FORMAT, _content_of(self))

    def __eq__(self, other: object) -> bool:
        return self.checksum == other.checksum if isinstance(other, Certificate) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.checksum)

    def __repr__(self) -> str:
        return f"<Certificate for the plant {self.fingerprint[:16]}, {self.contract or 'without a contract'}>"

    def __str__(self) -> str:
        (m, n), recorded, kept = self.K.shape, self.provenance, self.safe_set
        if isinstance(kept, Polytope):
            form = "|g x| <= 1" if kept.is_symmetric else "low <= g x <= high"
            safe_set, sizes = f"the polytope {form} of {len(kept.rows)} rows g", np.nan_to_num(kept.widths, posinf=0.0)
        else:
            sizes = np.sqrt(np.diag(kept.shape_matrix))
            widths = ", ".join(f"{width:.4g}" for width in sizes)
            safe_set = f"the ellipsoid x'Mx <= 1, that reaches |x_i| <= {widths}"
        fallback = "u = K x_hat"
        if self.resting_state.any() or self.resting_input.any():
            x_c, u_c = (
                ", ".join(f"{0.0 if abs(each) <= _DUST * size else each:.4g}" for each, size in zip(*of, strict=True))
                for of in ((self.resting_state, sizes), (self.resting_input, np.abs(self.K) @ sizes))
            )
            fallback = f"u = u_c + K (x_hat - x_c), with x_c = ({x_c}) and u_c = ({u_c}) from the operating point"
        rows = [
            ("plant", f"{counted(n, 'state')}, {counted(m, 'input')}, fingerprint {self.fingerprint[:16]}"),
            ("safe set", safe_set),
            ("claim", "in the safe box at the sampling instants, and between them only where it says so below"),
            ("size", size_of(recorded)),
            ("fallback", fallback),
            ("contract", contract_text(self.contract)),
            *provenance_rows(recorded),
        ]
        return table("Certificate of a robust control invariant set (shields.verify checks it)", rows)

    def recording(self, known: dict[str, Any]) -> Certificate:
        """Returns the same certificate, whose provenance says more."""
        return replace(self, provenance=self.provenance | known)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a JSON file in which every float is exact; a reader never sees a partial file.

        Raises:
            OSError: If the file cannot be written.
        """
        write_document(path, self.document)

    @classmethod
    def read(cls, given: Certificate | Mapping[str, Any] | str | os.PathLike[str]) -> Certificate:
        """Returns a certificate that is given as such, as its `document`, or as the path of its file.

        Raises:
            CertificateError: If the document or file is missing, damaged or altered.
        """
        if isinstance(given, Certificate):
            return given
        name = "document" if isinstance(given, Mapping) else given
        try:
            text = json.dumps(given) if isinstance(given, Mapping) else read_text(given)
            content = content_of(text, name, "certificate", _FORMAT)
        except OSError as error:
            raise CertificateError(f"cannot read certificate {name}: {error.strerror}") from error
        except (TypeError, ValueError, RecursionError) as error:
            raise CertificateError(str(error)) from error
        try:
            certificate = cls(**_fields_of(content))
            if _content_of(certificate) != content:
                raise ValueError("it would be written otherwise")
        except CertificateError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise CertificateError(
                f"{name} is not a certificate: an entry is missing, unknown, or of a wrong kind"
            ) from error
        return certificate

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Certificate:
        """Returns the certificate in a file; its conditions are not verified by this.

        Raises:
            CertificateError: If the file is missing, not a certificate, truncated or altered.
        """
        return cls.read(path)


def _content_of(certificate: Certificate) -> dict[str, Any]:
    """Returns the content of a file; lists of proofs are by age."""
    c, proofs, updates = certificate, certificate.proofs, certificate.updates
    if isinstance(c.safe_set, Polytope):
        safe_set = polytope_content(c.safe_set)
    else:
        by_age = {name: [getattr(proof, name).tolist() for proof in proofs] for name in _OF_ELLIPSOID}
        safe_set = {"L": c.safe_set.shape_matrix.tolist()} | by_age | {"rounding": c.rounding}
    return {
        "safe_set": safe_set,
        "K": c.K.tolist(),
        "D": c.D.tolist(),
        "errors": {"shapes": c.error_shapes.tolist(), "rates": [proof.rate for proof in proofs]},
        "updates": updates
        and {"contract": asdict(updates.contract)} | {name: getattr(updates, name).tolist() for name in _OF_UPDATES},
        "resting_state": c.resting_state.tolist(),
        "resting_input": c.resting_input.tolist(),
        "fingerprint": c.fingerprint,
        "provenance": c.provenance,
    }


def _fields_of(content: dict[str, Any]) -> dict[str, Any]:
    """Raises KeyError, TypeError or ValueError if an entry is missing or of a wrong kind."""
    names = ("K", "D", "resting_state", "resting_input", "fingerprint", "provenance")
    fields = {name: content[name] for name in names}
    kept, errors, updates = content["safe_set"], content["errors"], content["updates"]
    shapes, rates = errors["shapes"], errors["rates"]
    if "L" in kept:
        fields |= {"safe_set": Ellipsoid(kept["L"]), "rounding": kept["rounding"]}
        multipliers = [kept[name] for name in _OF_ELLIPSOID]
    else:
        fields["safe_set"] = polytope_of(kept, fields["resting_state"])
        multipliers = [[None] * len(shapes)] * 2
    found = zip(shapes, rates, *multipliers, strict=True)
    fields["proofs"] = tuple(Proof(Sigma=Sigma, rate=rate, shares=shares, inputs=u) for Sigma, rate, shares, u in found)
    if updates is not None:
        contract = ChannelContract(**updates["contract"])
        fields["updates"] = Updates(contract=contract, **{name: updates[name] for name in _OF_UPDATES})
    return fields


def _as_array(value: Any, shape: tuple[int | None, ...], name: str) -> np.ndarray:
    """Returns numbers, finite or not, as a float64 array of a shape, in which None stands for any length."""
    array = as_setting(value)
    if array is None or array.ndim != len(shape):
        raise ValueError(f"{name} must be numbers of shape {shape}, got {shown(value)}")
    if any(want not in (None, have) for have, want in zip(array.shape, shape, strict=True)):
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    return array
