"""The certificate of the published method, and the constraints of OP (Liu et al. Definition 4), checked exactly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.validation import ReadOnlyArrays, as_matrix, as_number
from shields.certificate_text import counted, table
from shields.errors import CertificateError
from shields.paper.bounds import SMALLEST_GAP, SYMMETRIC, PaperModel, unknown_bounds
from shields.verification import Report
from shields.verification.rational_matrix import (
    Condition,
    Matrix,
    add,
    flag,
    matrix_condition,
    multiply,
    quadratic,
    rational,
    scalar_condition,
    scale,
    subtract,
    transpose,
)

# alpha and eps_up are square roots and quantiles in float64; their rounding counts as this much against the
# certificate.
_ROUNDING = Fraction(1, 10**12)


@dataclass(frozen=True, eq=False, kw_only=True)
class PaperCertificate(ReadOnlyArrays):
    """A set E(L) and a gain that meet the constraints of OP (Liu et al. Definition 4).

    It carries the guarantee of the paper's own definitions, which assumes e'e <= epsilon at every step. It has no error
    set, so that no shield takes it.

    Attributes:
        L: Shape of the ellipsoid, (n, n) [squares of the states' units].
        K: Gain of u = K x_hat, shape (m, n) [input per state].
        kappa: Contraction factor.
        rho: Bound on the condition number of L.
        epsilon: Bound on the squared state error of Theorem 3.
        epsilon_up: Bound on the squared uplink error of Theorem 2.
        fingerprint: Fingerprint of the plant that it belongs to.
        provenance: How it was made; it proves nothing.
    """

    L: np.ndarray
    K: np.ndarray
    kappa: float
    rho: float
    epsilon: float
    epsilon_up: float
    fingerprint: str
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        try:
            n = len(as_matrix(self.L, (None, None), "L"))
            numbers = {name: as_number(getattr(self, name), name) for name in ("kappa", "rho", "epsilon", "epsilon_up")}
            self._set(L=as_matrix(self.L, (n, n), "L"), K=as_matrix(self.K, (None, n), "K"), **numbers)
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: {error}") from error

    def __str__(self) -> str:
        m, n = self.K.shape
        widths = ", ".join(f"{width:.4g}" for width in np.sqrt(np.diag(self.L)))
        rows = [
            ("plant", f"{counted(n, 'state')}, {counted(m, 'input')}, fingerprint {self.fingerprint[:16]}"),
            ("set", f"x'Mx <= 1, that reaches |x_i| <= {widths}"),
            ("constants", f"kappa {self.kappa:.4g}, rho {self.rho:.4g}, epsilon {self.epsilon:.4g}"),
            ("guarantee", "the paper's own: invariance if e'e <= epsilon at every step"),
        ]
        return table("Certificate of OP and Algorithm 1 of Liu et al. (shields.paper.verify checks it)", rows)


def verify(certificate: PaperCertificate, plant: LinearPlant) -> Report:
    """Returns whether the constraints (C1)-(C7) of OP hold for a certificate and a plant, in exact arithmetic.

    Raises:
        ValueError: If an argument is of another kind.
    """
    if not isinstance(certificate, PaperCertificate) or not isinstance(plant, LinearPlant):
        kinds = f"{type(certificate).__name__} and {type(plant).__name__}"
        raise ValueError(f"shields.paper.verify takes a PaperCertificate and a LinearPlant, got {kinds}")
    belongs = flag("plant: the certificate belongs to it", plant.digest() == certificate.fingerprint)
    return Report((belongs, *_conditions(certificate, plant)))


def _conditions(certificate: PaperCertificate, plant: LinearPlant) -> Iterator[Condition]:
    """Yields (C1)-(C7).

    U and tau are eliminated: (C4)-(C6) can be met for input i exactly if
    u_max^2 / 2 - K_i L K_i' - |K_i L|^2 eps_up / alpha^2 >= 0.
    """
    fits = certificate.L.shape == (plant.n, plant.n) and certificate.K.shape == (plant.m, plant.n)
    yield flag("shapes: L (n, n), K (m, n)", fits)
    if not fits:
        return
    if not plant.is_symmetric:
        yield flag(f"limits: the paper's theorems know {SYMMETRIC}", False)
        return
    if unknown := unknown_bounds(plant):
        yield flag(f"bounds: the paper's theorems do not know {' and '.join(unknown)}", False)
        return
    kappa, rho = Fraction(certificate.kappa), Fraction(certificate.rho)
    inside = kappa > 0 and rho >= 1 and 1 - kappa * rho >= SMALLEST_GAP
    yield flag("0 < kappa, 1 <= rho, kappa rho < 1", inside)
    if not inside:
        return
    bounds = PaperModel(plant).at(certificate.kappa, certificate.rho)
    stated = np.array([certificate.epsilon_up, certificate.epsilon])
    agree = np.allclose(stated, [bounds.epsilon_up, bounds.epsilon], rtol=1e-9, atol=0.0)
    yield flag("eps_up and eps are those of Theorems 2 and 3", bool(agree))
    L, K = rational(certificate.L), rational(certificate.K)
    identity = rational(np.eye(plant.n))
    closed_loop = multiply(add(rational(plant.A), multiply(rational(plant.B), K)), L)
    yield matrix_condition("L > 0", L, strict=True)
    yield matrix_condition("(C1) [kappa L, *; (A+BK) L, L] >= 0", _blocks(scale(kappa, L), closed_loop, L))
    alpha = Fraction(bounds.alpha)
    yield matrix_condition("(C2) L >= alpha I", subtract(L, scale(alpha * (1 + _ROUNDING), identity)))
    for j, row in enumerate(plant.box):
        yield scalar_condition(f"(C3) c_{j + 1} L c_{j + 1}' <= 1", 1 - quadratic(rational(row), L))
    for i, limit in enumerate(plant.largest_input):
        F = multiply([K[i]], L)
        used = quadratic([K[i]], L)
        if bounds.epsilon_up > 0.0:
            error = Fraction(bounds.epsilon_up) * (1 + _ROUNDING) / (alpha * (1 - _ROUNDING)) ** 2
            used += error * multiply(F, transpose(F))[0][0]
        yield scalar_condition(f"(C4)-(C6) input {i + 1}", Fraction(float(limit)) ** 2 / 2 - used)
    beta = _smallest_eigenvalue(certificate.L)
    yield matrix_condition("(C7) L >= beta I", subtract(L, scale(beta, identity)))
    yield matrix_condition("(C7) L <= rho beta I", subtract(scale(rho * beta, identity), L))


def _smallest_eigenvalue(L: np.ndarray) -> Fraction:
    """Returns a rational just below lambda_min(L); exactly lambda_min(L) for a multiple of the identity."""
    if np.array_equal(L, L[0, 0] * np.eye(len(L))):
        return Fraction(float(L[0, 0]))
    return Fraction(float(np.linalg.eigvalsh(L)[0])) * (1 - _ROUNDING)


def _blocks(top: Matrix, corner: Matrix, bottom: Matrix) -> Matrix:
    """Returns the matrix [top, corner'; corner, bottom]."""
    rows = zip([*top, *corner], [*transpose(corner), *bottom], strict=True)
    return [left + right for left, right in rows]
