"""The certificate: an invariant ellipsoid, its gain and the numbers that prove it."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from ncs_gym import ChannelContract, Ellipsoid
from ncs_gym.validation import ReadOnlyArrays, as_matrix, as_number, read_only, shown
from shields import certificate_file
from shields.certificate_text import description_of
from shields.errors import CertificateError
from shields.proof_data import CertifiedProof, ContractProof, Multipliers, PaperConstants

# The fields that a certificate of each method has besides L and K, and that one of the other method must not have.
_FIELDS = {
    "certified": ("Sigma", "D", "multipliers"),
    "paper": ("kappa", "rho", "epsilon", "epsilon_up"),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Certificate(ReadOnlyArrays):
    """A robust control invariant set S = {x : x'Mx <= 1} inside the safe box, its gain, and the numbers that prove it.

    A certificate is not trusted until `shields.verify` has checked it in exact arithmetic. Two certificates are equal
    if their files are, every digit of them. `print(certificate)` says what it is for.

    Attributes:
        L: Shape of the safe set, (n, n) [squares of the states' units]; S = E(L).
        K: Gain of the fallback input u = K x_hat, shape (m, n) [input per state].
        Sigma: Shape of the certified error set, (n, n), under a contract that of the largest age; None for "paper".
        D: Shape of the disturbance set that the proof assumes, (n, n); None for "paper".
        multipliers: Multipliers of the conditions, under a contract those of the largest age; None for "paper".
        ages: Error sets and multipliers for every age that a channel contract allows; None without a contract.
        method: Method of the synthesis, "certified" or "paper".
        fingerprint: Fingerprint of the plant that the certificate belongs to.
        kappa: Contraction factor of OP; this and the next three are None unless the method is "paper".
        rho: Bound of OP on the condition number of L.
        epsilon: Bound on the squared state error of Liu et al. Theorem 3.
        epsilon_up: Bound on the squared uplink error of Liu et al. Theorem 2.
        provenance: How the certificate was made (solver, versions, volume); it proves nothing.
    """

    L: np.ndarray
    K: np.ndarray
    Sigma: np.ndarray | None = None
    D: np.ndarray | None = None
    multipliers: Multipliers | None = None
    ages: ContractProof | None = None
    method: str
    fingerprint: str
    kappa: float | None = None
    rho: float | None = None
    epsilon: float | None = None
    epsilon_up: float | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises CertificateError if a field is missing, belongs to the other method, or is of the wrong kind."""
        try:
            self._check_fields()
            n = len(np.atleast_2d(self.L))
            matrices = {"L": n, "K": None} | ({"Sigma": n, "D": n} if self.method == "certified" else {})
            for name, rows in matrices.items():
                object.__setattr__(self, name, as_matrix(getattr(self, name), (rows, n), name))
            for name in _FIELDS["paper"] if self.method == "paper" else ():
                object.__setattr__(self, name, as_number(getattr(self, name), name))
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: {error}") from error
        self._make_arrays_read_only()

    def _check_fields(self) -> None:
        """Raises ValueError unless exactly the fields of the certificate's method are given."""
        if self.method not in ("certified", "paper"):
            raise ValueError(f"its method must be 'certified' or 'paper', got {shown(self.method)}")
        other = "paper" if self.method == "certified" else "certified"
        wrong = [name for name in _FIELDS[self.method] if getattr(self, name) is None]
        wrong += [name for name in _FIELDS[other] if getattr(self, name) is not None]
        if not (isinstance(self.provenance, dict) and isinstance(self.fingerprint, str)):
            raise ValueError("its provenance must be a dict, and its fingerprint a text")
        if wrong:
            raise ValueError(f"one of method {self.method!r} has other entries: {', '.join(wrong)}")
        if self.ages is not None and self.method == "paper":
            raise ValueError("one of method 'paper' has no proof by age")

    def proof(self) -> CertifiedProof:
        """Returns the numbers with which the conditions of theory.md section 3 are verified.

        Raises:
            CertificateError: If the method is "paper", which has none.
        """
        if self.Sigma is None or self.D is None or self.multipliers is None:
            raise CertificateError(f"a certificate of method {self.method!r} has no error set to verify")
        return CertifiedProof(self.Sigma, self.D, self.multipliers, self.ages)

    def constants(self) -> PaperConstants:
        """Returns the constants with which the constraints of OP are verified.

        Raises:
            CertificateError: If the method is "certified", which has none.
        """
        if self.kappa is None or self.rho is None or self.epsilon is None or self.epsilon_up is None:
            raise CertificateError(f"a certificate of method {self.method!r} has no constants of OP to verify")
        return PaperConstants(self.kappa, self.rho, self.epsilon, self.epsilon_up)

    @cached_property
    def M(self) -> np.ndarray:
        """The inverse of L, shape (n, n)."""
        inverse = np.linalg.inv(self.L)
        return read_only(0.5 * (inverse + inverse.T))

    @cached_property
    def safe_set(self) -> Ellipsoid:
        """The robust control invariant set S = E(L)."""
        return Ellipsoid(self.L)

    @property
    def contract(self) -> ChannelContract | None:
        """The channel contract that it assumes; None without one."""
        return None if self.ages is None else self.ages.sets.contract

    @cached_property
    def error_set(self) -> Ellipsoid | None:
        """The certified error set E(Sigma); None for method "paper"."""
        return None if self.Sigma is None else Ellipsoid(self.Sigma)

    @property
    def error_shapes(self) -> np.ndarray:
        """The shapes of all error sets for which K x_hat keeps the state in S, (k, n, n); k = 0 for method "paper"."""
        if self.ages is not None:
            return self.ages.sets.shapes[:-1]
        return np.empty((0, *self.L.shape)) if self.Sigma is None else self.Sigma[None]

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the content of the certificate's file."""
        return self.document["sha256"]

    @property
    def document(self) -> dict[str, Any]:
        """The content of the certificate's file: the format's name, the checksum and the fields, as JSON values."""
        return certificate_file.document_of({entry.name: getattr(self, entry.name) for entry in fields(self)})

    def __eq__(self, other: object) -> bool:
        return self.checksum == other.checksum if isinstance(other, Certificate) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.checksum)

    def __str__(self) -> str:
        return description_of(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a JSON file in which every float is exact; a reader never sees a partial file.

        Raises:
            OSError: If the file cannot be written.
        """
        certificate_file.write(path, self.document)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Certificate:
        """Returns the certificate in a file; its conditions are not verified by this.

        Raises:
            CertificateError: If the file is missing, not a certificate, truncated or altered.
        """
        return cls(**certificate_file.read(path, [entry.name for entry in fields(cls)]))
