"""The numbers of a filter on a board: everything that depends on the age of the newest sample alone.

Statement and proof are in docs/shield_proof.md, "On a board".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.estimation.error_bound import ErrorSet, require_error_set
from ncs_gym.plants.linear_plant import SIMULATED_REACH
from ncs_gym.validation import ReadOnlyArrays
from shields.certificate import Certificate, CertificateError, Updates
from shields.polytope import Polytope
from shields.runtime.safety_filter import MARGIN, SafetyFilter

# A residual beyond its bound by less than this, relative to it, counts as rounding, not as an alarm.
ALARM_TOLERANCE = 1e-9
_ROWS = "joint", "middle", "limit"
_FNV_START, _FNV_PRIME = 14695981039346656037, 1099511628211


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardTable(ReadOnlyArrays):
    """The numbers of the filter, in the order in which they stand in C: n states, m inputs, p outputs, r rows.

    Attributes:
        A, B, H: Of the plant.
        K, constant: Of the fallback u = K x_hat + constant, shapes (m, n) and (m,).
        low, high: The ends of the inputs, shape (m,).
        far: The largest |x_hat|, up to which rounding is bounded, shape (n,).
        T: Gains T_1 .. T_{h+1}, by the steps since the sample used before, shape (h+1, n, p).
        alarm: The largest possible |y - H x_hat|, by the same, shape (h+1, p).
        G: The rows of the safe set, shape (r, n).
        start: The largest |G x_hat - middle| of a first estimate that proves the state inside, shape (r,).
        rounding: What every limit below loses for each unit of |x_hat|, shape (n,).
        joint: G A and G B beside each other, shape (r, n + m), float32 or float64, as are the next two.
        middle: Of the ends of the rows, shape (r,).
        limit: The largest |G (A x_hat + B u) - middle| that passes, by the age of the newest sample, shape (h+1, r):
            half of the range less the reach of error and disturbance, rounding, and MARGIN.
        margin: What a projected input keeps of the limits.
    """

    A: np.ndarray
    B: np.ndarray
    H: np.ndarray
    K: np.ndarray
    constant: np.ndarray
    low: np.ndarray
    high: np.ndarray
    far: np.ndarray
    T: np.ndarray
    alarm: np.ndarray
    G: np.ndarray
    start: np.ndarray
    rounding: np.ndarray
    joint: np.ndarray
    middle: np.ndarray
    limit: np.ndarray
    margin: float

    def __post_init__(self) -> None:
        self._make_arrays_read_only()

    @classmethod
    def of(cls, certificate: Certificate, plant: LinearPlant, *, single: bool = False) -> Self:
        """Returns the table of a certificate, which is verified exactly.

        Args:
            certificate: The certificate.
            plant: The plant it was made for.
            single: Whether the rows are float32.

        Raises:
            CertificateError: If it does not verify for the plant, or is of a kind that is not exported.
            ErrorSetError: If its gains leave no room for the rounding of an estimate.
        """
        updates = _exported(certificate, plant)
        ready = SafetyFilter(certificate, plant, "switch")
        test, reach, shapes = ready.test, SIMULATED_REACH * plant.half_widths, [*certificate.error_shapes, updates.last]
        require_error_set(
            ErrorSet(
                contract=updates.contract,
                shapes=np.array(shapes),
                rates=np.array([proof.rate for proof in certificate.proofs]),
                gains=updates.gains,
                multipliers=updates.shares,
                noise=updates.noise,
            ),
            plant,
        )
        errors = ready.errors_of_many(np.array([plant.initial_error.shape_matrix, *shapes[:-1]]))
        residuals = np.sqrt([np.diag(plant.H @ Sigma @ plant.H.T) for Sigma in shapes[1:]])
        residuals = residuals + np.sqrt(np.diag(updates.noise))
        kind = np.finfo(np.float32 if single else np.float64)
        rounding = test.rounding + (plant.n + plant.m + 6) * float(kind.eps)
        joint, pushed = np.hstack([test.state_rows, test.input_rows]), test.pushed + np.abs(test.middle)
        lost = rounding * (pushed + test.half) + MARGIN
        lost += float(kind.tiny) * joint.size * (1.0 + np.abs(joint).max() + reach.max() + plant.largest_input.max())
        limit, middle = (errors.row_limits[:, 1:].T - lost).astype(kind.dtype), test.middle.astype(kind.dtype)
        table = cls(
            **{name: getattr(plant, name) for name in "ABH"},
            K=certificate.K,
            constant=certificate.fallback.constant,
            low=plant.input_ends[0],
            high=plant.input_ends[1],
            far=reach - np.sqrt(np.diagonal(shapes, axis1=1, axis2=2).max(axis=0)),
            T=updates.gains,
            alarm=residuals * (1.0 + ALARM_TOLERANCE) + test.rounding * (np.abs(plant.H) @ reach),
            G=test.root,
            start=test.half - errors.own[:, 0] - test.rounding * float(test.own_columns @ reach) - lost,
            rounding=(1.0 + 1e-6) * rounding * test.columns,
            joint=joint.astype(kind.dtype),
            middle=middle,
            limit=np.nextafter(limit, kind.dtype.type(-np.inf)),
            margin=MARGIN + 4.0 * rounding * float((pushed + test.half).max()),
        )
        if not all(np.isfinite(each).all() for each in (table.doubles | table.rows).values()):
            raise CertificateError("the certificate is not exported: its numbers are out of reach of the board's")
        return table

    @property
    def doubles(self) -> dict[str, np.ndarray]:
        """All arrays in double precision by their names."""
        arrays = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {name: each for name, each in arrays.items() if name not in (*_ROWS, "margin")}

    @property
    def rows(self) -> dict[str, np.ndarray]:
        """All arrays in the precision of the rows by their names."""
        return {name: getattr(self, name) for name in _ROWS}

    @property
    def sizes(self) -> dict[str, int]:
        """n, m, p, h and r by their names in C."""
        (n, m), (h, r) = self.B.shape, self.limit.shape
        return {"N": n, "M": m, "P": len(self.H), "H": h - 1, "ROWS": r}

    @property
    def checksum(self) -> int:
        """FNV-1a with 64 bits over sizes and numbers, all of them as doubles."""
        value = _FNV_START
        arrays = [list(self.sizes.values()), *(self.doubles | self.rows).values()]
        for byte in np.concatenate([np.ravel(each) for each in arrays]).astype("<f8").tobytes():
            value = (value ^ byte) * _FNV_PRIME % 2**64
        return value

    @property
    def cost(self) -> str:
        """What it takes on a board, as a sentence: memory, and the longest step."""
        n, m, p, h, r = self.sizes.values()
        numbers = sum(each.nbytes for each in (self.doubles | self.rows).values())
        state, move, test = 8 * (2 * n + (h + 1) * m) + 32, n * (n + m), r * (n + m)
        decision = (4 if m == 1 else 2) * (test + n) + m * n + (h + 2) * move
        divisions = 2 * r if m == 1 else 0
        return (
            f"{numbers:,} bytes of numbers and {state:,} bytes of state; at most {decision:,} multiplications and "
            f"{divisions:,} divisions for a decision, {(h + 1) * move + 2 * n * p:,} multiplications for a sample"
        )


def _exported(certificate: Certificate, plant: LinearPlant) -> Updates:
    """Returns what a contract adds to a certificate; raises CertificateError if its kind is not exported."""
    is_polytope = isinstance(certificate.safe_set, Polytope)
    reasons = {
        "it has no polytope: give one of ncs synthesize --safe-set polytope": not is_polytope,
        "it has no channel contract: give one of ncs synthesize --max-age": certificate.updates is None,
        "its plant has a remainder": plant.remainder is not None,
        "its plant limits states and inputs together, or the box between samples": len(plant.step_rows) > 0,
    }
    for reason, holds in reasons.items():
        if holds:
            raise CertificateError(f"the certificate is not exported, since {reason}")
    assert certificate.updates is not None
    return certificate.updates
