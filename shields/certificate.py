"""The certificate: an invariant ellipsoid, its gain and the numbers that prove it."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import Ellipsoid
from ncs_gym.estimation.error_bounds_by_age import AgeSets
from ncs_gym.network.contract import ChannelContract
from ncs_gym.validation import FrozenArrays, as_matrix, as_number, as_setting, read_only, shown
from shields.atomic_write import write_atomically

FORMAT = "ncs-gym certificate 2"
# What a certificate of each method carries besides L and K.
PROOF = ("Sigma", "D", "multipliers")
CONSTANTS = ("kappa", "rho", "epsilon", "epsilon_up")
SET_ARRAYS = ("shapes", "rates", "gains", "shares", "noise")


class CertificateError(ValueError):
    """A certificate is damaged, belongs to another plant, or does not verify."""


class PaperConstants(NamedTuple):
    """What a certificate of method "paper" is verified with, besides L and K; see `Certificate`."""

    kappa: float
    rho: float
    epsilon: float
    epsilon_up: float


@dataclass(frozen=True, kw_only=True)
class Multipliers:
    """The shares that the conditions of theory.md section 3 are verified with.

    Attributes:
        error: lam_e of (E1).
        state: lx of (I).
        estimate: le of (I).
        disturbance: ld of (I).
        inputs: mu_i of (U), one per input.
        rounding: s of D_u, the growth of D that makes room for actions rounded to float32.
    """

    error: float
    state: float
    estimate: float
    disturbance: float
    inputs: tuple[float, ...]
    rounding: float

    def __post_init__(self) -> None:
        """Raises CertificateError if a share is not a number."""
        try:
            for name in ("error", "state", "estimate", "disturbance", "rounding"):
                object.__setattr__(self, name, _as_float(getattr(self, name)))
            object.__setattr__(self, "inputs", tuple(_as_float(share) for share in self.inputs))
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: its multipliers must be numbers, {error}") from error


@dataclass(frozen=True, eq=False, kw_only=True)
class AgeProof(FrozenArrays):
    """What a certificate under a channel contract proves, age by age (docs/theory.md section 6).

    Attributes:
        sets: Error sets by age, with the gains that keep them and the contract they rest on.
        shares: lx, le, ld of (I) for each age 0..h, shape (h+1, 3).
        inputs: mu_i of (U) for each age 0..h, shape (h+1, m).
    """

    sets: AgeSets
    shares: np.ndarray
    inputs: np.ndarray

    def __post_init__(self) -> None:
        """Raises CertificateError if the numbers do not fit together."""
        try:
            sets, steps = self.sets, self.sets.contract.max_age + 1
            if not isinstance(sets.contract, ChannelContract):
                raise ValueError("its contract is no ChannelContract")
            n, p = len(sets.shapes[0]), len(sets.noise)
            expected = {"shapes": (steps + 1, n, n), "rates": (steps,), "gains": (steps, n, p), "shares": (steps,)}
            arrays = {
                name: np.array(as_setting(getattr(sets, name)), dtype=np.float64) for name in (*expected, "noise")
            }
            expected |= {"noise": (p, p)}
            for name, shape in expected.items():
                if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
                    raise ValueError(f"{name} must be finite with shape {shape}")
            object.__setattr__(self, "sets", AgeSets(contract=sets.contract, **arrays))
            object.__setattr__(self, "shares", as_matrix(self.shares, (steps, 3), "shares"))
            object.__setattr__(self, "inputs", as_matrix(self.inputs, (steps, None), "inputs"))
        except (AttributeError, IndexError, TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: in its proof by age, {error}") from error
        self._freeze_arrays()


class Proof(NamedTuple):
    """What a certificate of method "certified" is verified with, besides L and K; see `Certificate`."""

    Sigma: np.ndarray
    D: np.ndarray
    multipliers: Multipliers
    ages: AgeProof | None


@dataclass(frozen=True, eq=False, kw_only=True)
class Certificate(FrozenArrays):
    """A robust safety invariant set S = {x : x'Mx <= 1} with gain K, and the proof's numbers.

    Nothing here is trusted until `shields.verify` has checked it in exact arithmetic.

    Attributes:
        L: Shape of the safe set, (n, n); S = E(L).
        K: Gain of the fallback input u = K x_hat, (m, n) [input per state].
        Sigma: Shape of the certified error set, (n, n), under a contract of its largest age; None for "paper".
        D: Shape of the disturbance set it was made for, (n, n); None for "paper".
        multipliers: See `Multipliers`, under a contract those of its largest age; None for "paper".
        ages: The proof by age under a channel contract; None without one.
        method: "certified" or "paper".
        fingerprint: Of the plant it belongs to.
        kappa, rho, epsilon, epsilon_up: Constants of OP ("paper" only).
        provenance: How it was made (solver, versions, volume); informative only.
    """

    L: np.ndarray
    K: np.ndarray
    Sigma: np.ndarray | None = None
    D: np.ndarray | None = None
    multipliers: Multipliers | None = None
    ages: AgeProof | None = None
    method: str
    fingerprint: str
    kappa: float | None = None
    rho: float | None = None
    epsilon: float | None = None
    epsilon_up: float | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        try:
            n = len(np.atleast_2d(self.L))
            own, foreign = (PROOF, CONSTANTS) if self.method == "certified" else (CONSTANTS, PROOF)
            if self.method not in ("certified", "paper"):
                raise ValueError(f"its method must be 'certified' or 'paper', got {shown(self.method)}")
            wrong = [name for name in own if getattr(self, name) is None]
            wrong += [name for name in foreign if getattr(self, name) is not None]
            if not (isinstance(self.provenance, dict) and isinstance(self.fingerprint, str)):
                raise ValueError("its provenance must be a dict, and its fingerprint a text")
            if wrong:
                raise ValueError(f"one of method {self.method!r} has other entries: {', '.join(wrong)}")
            if self.ages is not None and own is CONSTANTS:
                raise ValueError("one of method 'paper' has no proof by age")
            matrices = [("L", n), ("K", None)] + [(name, n) for name in ("Sigma", "D") if name in own]
            for name, rows in matrices:
                object.__setattr__(self, name, as_matrix(getattr(self, name), (rows, n), name))
            for name in CONSTANTS if own is CONSTANTS else ():
                object.__setattr__(self, name, as_number(getattr(self, name), name))
        except ValueError as error:
            raise CertificateError(f"not a certificate: {error}") from error
        self._freeze_arrays()

    def proof(self) -> Proof:
        """Returns the numbers that theory.md section 3 is verified with.

        Raises:
            CertificateError: If the method is "paper", which has none.
        """
        if self.Sigma is None or self.D is None or self.multipliers is None:
            raise CertificateError(f"a certificate of method {self.method!r} has no error set to verify")
        return Proof(self.Sigma, self.D, self.multipliers, self.ages)

    def constants(self) -> PaperConstants:
        """Returns the constants that OP is verified with.

        Raises:
            CertificateError: If the method is "certified", which has none.
        """
        if self.kappa is None or self.rho is None or self.epsilon is None or self.epsilon_up is None:
            raise CertificateError(f"a certificate of method {self.method!r} has no constants of OP to verify")
        return PaperConstants(self.kappa, self.rho, self.epsilon, self.epsilon_up)

    @cached_property
    def M(self) -> np.ndarray:
        """L^-1, shape (n, n)."""
        inverse = np.linalg.inv(self.L)
        return read_only(0.5 * (inverse + inverse.T))

    @cached_property
    def safe_set(self) -> Ellipsoid:
        """S = E(L)."""
        return Ellipsoid(self.L)

    @cached_property
    def error_set(self) -> Ellipsoid | None:
        """E(Sigma); None for "paper"."""
        return None if self.Sigma is None else Ellipsoid(self.Sigma)

    @property
    def error_shapes(self) -> np.ndarray:
        """Every certified Sigma_j that K x_hat is safe with, shape (k, n, n); none for "paper"."""
        if self.ages is not None:
            return self.ages.sets.shapes[:-1]
        return np.empty((0, *self.L.shape)) if self.Sigma is None else self.Sigma[None]

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the content of its file."""
        return _digest(json.loads(json.dumps(self._content()), parse_float=str, parse_int=str))

    @property
    def document(self) -> dict[str, Any]:
        """The content of its file, JSON values."""
        return {"format": FORMAT, "sha256": self.checksum, "certificate": self._content()}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes JSON in which every float is exact; a reader never sees half a file.

        Raises:
            OSError: If the file cannot be written.
        """
        write_atomically(Path(path), json.dumps(self.document, indent=1) + "\n")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Certificate:
        """Returns the certificate in a file; its conditions are not verified by this.

        Raises:
            CertificateError: If the file is missing, not a certificate, truncated or altered.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
            document, literal = json.loads(text), json.loads(text, parse_float=str, parse_int=str)
        except (OSError, TypeError, ValueError, RecursionError) as error:
            reason = getattr(error, "strerror", None) or "it is not valid JSON"
            raise CertificateError(f"cannot read certificate {path}: {reason}") from error
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise CertificateError(f"{path} is not a certificate of format {FORMAT!r}")
        try:
            content = document["certificate"]
            if document["sha256"] != _digest(literal["certificate"]):
                raise CertificateError(f"certificate {path} was altered: its checksum does not match")
            return cls(**_from_content(content))
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, CertificateError):
                raise
            raise CertificateError(f"{path} is not a certificate: an entry is missing or of a wrong kind") from error

    def _content(self) -> dict[str, Any]:
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                values[name] = value.tolist()
        values["multipliers"] = None if self.multipliers is None else asdict(self.multipliers)
        if self.ages is not None:
            sets = self.ages.sets
            arrays = {name: getattr(sets, name).tolist() for name in SET_ARRAYS}
            shares = {"shares": self.ages.shares.tolist(), "inputs": self.ages.inputs.tolist()}
            values["ages"] = {"contract": asdict(sets.contract), "sets": arrays, **shares}
        return values


def _from_content(content: dict[str, Any]) -> dict[str, Any]:
    values = {entry.name: content[entry.name] for entry in fields(Certificate)}
    if values["multipliers"] is not None:
        values["multipliers"] = Multipliers(**values["multipliers"])
    if values["ages"] is not None:
        ages = values["ages"]
        arrays = {name: np.array(as_setting(ages["sets"][name]), dtype=np.float64) for name in SET_ARRAYS}
        sets = AgeSets(contract=ChannelContract(**ages["contract"]), **arrays)
        values["ages"] = AgeProof(sets=sets, shares=ages["shares"], inputs=ages["inputs"])
    return values


def _as_float(value: Any) -> float:
    """Returns a number as a float.

    Raises:
        ValueError: If it is none: a text that looks like one, or a truth value.
    """
    single = as_setting(value)
    if single is None or single.ndim:
        raise ValueError(f"got {shown(value)}")
    return float(single)


def _digest(content: Any) -> str:
    """Returns the checksum of a content whose numbers are their literal digits, whatever the white space."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
