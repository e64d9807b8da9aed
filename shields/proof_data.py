"""The numbers, besides L and K, with which a certificate's conditions are verified."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.estimation.error_bounds_by_age import ErrorSetsByAge
from ncs_gym.network.contract import ChannelContract
from ncs_gym.validation import ReadOnlyArrays, as_matrix, as_setting, shown
from shields.errors import CertificateError


@dataclass(frozen=True, kw_only=True)
class Multipliers:
    """The S-procedure multipliers of the conditions of theory.md section 3, all without unit.

    Attributes:
        error: Multiplier lam_e of the error set's condition (E1), in (0, 1).
        state: Multiplier lx of the state in the invariance condition (I), > 0.
        estimate: Multiplier le of the estimation error in (I), > 0.
        disturbance: Multiplier ld of the disturbance in (I), > 0; lx + le + ld <= 1.
        inputs: Multipliers mu_i of the input limits (U), one per input, in (0, 1).
        rounding: Multiplier s of D_u, the disturbance set enlarged by the rounding of actions to float32, > 0.
    """

    error: float
    state: float
    estimate: float
    disturbance: float
    inputs: tuple[float, ...]
    rounding: float

    def __post_init__(self) -> None:
        """Raises CertificateError if a multiplier is not a number."""
        try:
            for name in ("error", "state", "estimate", "disturbance", "rounding"):
                object.__setattr__(self, name, _as_float(getattr(self, name)))
            object.__setattr__(self, "inputs", tuple(_as_float(multiplier) for multiplier in self.inputs))
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: its multipliers must be numbers, {error}") from error


@dataclass(frozen=True, eq=False, kw_only=True)
class ContractProof(ReadOnlyArrays):
    """The proof under a channel contract, one set of multipliers per age of the newest sample (theory.md section 6).

    Attributes:
        sets: Error sets by age, the estimator gains that keep the error in them, and the contract they assume.
        multipliers: Multipliers lx, le, ld of (I) for each age 0..h, shape (h+1, 3).
        inputs: Multipliers mu_i of (U) for each age 0..h, shape (h+1, m).
    """

    sets: ErrorSetsByAge
    multipliers: np.ndarray
    inputs: np.ndarray

    def __post_init__(self) -> None:
        """Raises CertificateError if the shapes are inconsistent or a number is not finite."""
        try:
            steps = self.sets.contract.max_age + 1
            object.__setattr__(self, "sets", _as_age_sets(self.sets))
            object.__setattr__(self, "multipliers", as_matrix(self.multipliers, (steps, 3), "multipliers"))
            object.__setattr__(self, "inputs", as_matrix(self.inputs, (steps, None), "inputs"))
        except (AttributeError, IndexError, TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: in its proof by age, {error}") from error
        self._make_arrays_read_only()


class CertifiedProof(NamedTuple):
    """What a certificate of method "certified" is verified with, besides L and K; see `Certificate`."""

    Sigma: np.ndarray
    D: np.ndarray
    multipliers: Multipliers
    ages: ContractProof | None


class PaperConstants(NamedTuple):
    """What a certificate of method "paper" is verified with, besides L and K; see `Certificate`."""

    kappa: float
    rho: float
    epsilon: float
    epsilon_up: float


def _as_age_sets(sets: ErrorSetsByAge) -> ErrorSetsByAge:
    """Returns error sets by age whose arrays are float64.

    Raises:
        ValueError: If an array has the wrong shape or is not finite, or the contract is of another kind.
    """
    if not isinstance(sets.contract, ChannelContract):
        raise ValueError("its contract is no ChannelContract")
    steps, n, p = sets.contract.max_age + 1, len(sets.shapes[0]), len(sets.noise)
    expected = {
        "shapes": (steps + 1, n, n),
        "rates": (steps,),
        "gains": (steps, n, p),
        "multipliers": (steps,),
        "noise": (p, p),
    }
    arrays = {name: np.array(as_setting(getattr(sets, name)), dtype=np.float64) for name in expected}
    for name, shape in expected.items():
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} must be finite with shape {shape}")
    return ErrorSetsByAge(contract=sets.contract, **arrays)


def _as_float(value: Any) -> float:
    """Returns a number as a float.

    Raises:
        ValueError: If it is not a number; a text of digits and a truth value are not.
    """
    single = as_setting(value)
    if single is None or single.ndim:
        raise ValueError(f"got {shown(value)}")
    return float(single)
