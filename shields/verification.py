"""Exact verification of a certificate, independent of how it was made."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ncs_gym import LinearPlant
from shields.certificate import Certificate, CertificateError
from shields.condition import Condition, flag, matrix_condition, scalar
from shields.exact import (
    Matrix,
    add,
    congruence,
    multiply,
    quadratic,
    rational,
    scale,
    subtract,
)
from shields.paper_conditions import paper_conditions

# Rounding an action in [-1, 1] to float32 moves it by at most this.
ACTION_ROUNDING = Fraction(1, 2**24)


@dataclass(frozen=True)
class Report:
    """The outcome of a verification.

    Attributes:
        conditions: Every condition, in order.
    """

    conditions: tuple[Condition, ...]

    @property
    def valid(self) -> bool:
        """Whether every condition holds."""
        return all(condition.holds for condition in self.conditions)

    def __str__(self) -> str:
        rows = (f"{'holds ' if c.holds else 'BROKEN'}  {c.margin:+.3e}  {c.name}" for c in self.conditions)
        return "\n".join(rows)


def verify(certificate: Certificate, plant: LinearPlant) -> Report:
    """Returns whether a certificate proves what it claims for a plant, in exact rational arithmetic.

    The conditions are (E0), (E1), (I), (S), (U) of theory.md section 3, and that D, N and r0^2 I contain what
    section 1 says they contain; for a certificate of method "paper" the constraints of OP instead (docs/paper.md). No
    tolerance, no solver, no float decides; the margins are for people.

    Args:
        certificate: The certificate.
        plant: The plant, with its bounds.

    Raises:
        ValueError: If an argument is of another kind.
    """
    if not isinstance(certificate, Certificate) or not isinstance(plant, LinearPlant):
        kinds = f"{type(certificate).__name__} and {type(plant).__name__}"
        raise ValueError(f"verify takes a Certificate and a LinearPlant, got {kinds}")
    conditions = [flag("plant: the certificate belongs to it", certificate.fingerprint == plant.fingerprint)]
    fits = certificate.L.shape == (plant.n, plant.n) and certificate.K.shape == (plant.m, plant.n)
    if certificate.method == "paper":
        conditions.append(flag("shapes: L (n, n), K (m, n)", fits))
        return Report(tuple(conditions + (list(paper_conditions(certificate, plant)) if fits else [])))
    conditions.append(flag("shapes: L (n, n), K (m, n), one input share per input", fits and _shares_fit(certificate)))
    if not conditions[-1].holds:
        return Report(tuple(conditions))
    conditions += _shares(certificate)
    if all(condition.holds for condition in conditions[2:]):
        conditions += _bounds(certificate, plant)
        conditions += _error_set(certificate, plant)
        conditions += _safe_set(certificate, plant)
    return Report(tuple(conditions))


def require_valid(certificate: Certificate, plant: LinearPlant) -> None:
    """Raises unless a certificate verifies for a plant.

    Raises:
        CertificateError: Naming the first condition that does not hold.
    """
    for condition in verify(certificate, plant).conditions:
        if not condition.holds:
            if condition.name.startswith("plant"):
                raise CertificateError("the certificate was made for another plant: their fingerprints differ")
            raise CertificateError(
                f"the certificate does not verify: {condition.name} does not hold (margin {condition.margin:.3g})"
            )


def _shares_fit(certificate: Certificate) -> bool:
    return len(certificate.multipliers.inputs) == certificate.K.shape[0]


def _shares(certificate: Certificate) -> Iterator[Condition]:
    """Checks the ranges of all multipliers."""
    shares = certificate.multipliers
    finite = all(np.isfinite([shares.error, shares.state, shares.estimate, shares.disturbance, shares.rounding]))
    finite = finite and all(np.isfinite(shares.inputs))
    yield flag("multipliers: finite", finite)
    if not finite:
        return
    inside = all(0.0 < share < 1.0 for share in (shares.error, *shares.inputs))
    yield flag("multipliers: 0 < lam_e < 1 and 0 < mu_i < 1", inside)
    parts = [Fraction(share) for share in (shares.state, shares.estimate, shares.disturbance)]
    positive = min(*parts, Fraction(shares.rounding)) > 0
    yield flag("multipliers: lx, le, ld, s > 0", positive)
    yield scalar("multipliers: lx + le + ld <= 1", 1 - sum(parts))


def _bounds(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks that D, N and r0^2 I contain what theory.md section 1 says."""
    identity = rational(np.eye(plant.n))
    noise = rational(plant.process_noise_cov)
    energy = Fraction(plant.process_noise.energy)
    ball = scale(Fraction(plant.gamma), identity)
    ellipsoid = scale(energy, noise)
    share = _trace_share(ball, ellipsoid)
    need = add(ball, ellipsoid) if share is None else add(scale(1 / share, ball), scale(1 / (1 - share), ellipsoid))
    bound = rational(plant.disturbance.shape)
    yield matrix_condition("D: the plant's holds the disturbance and the process noise", subtract(bound, need))
    yield matrix_condition("D: the certificate's holds the plant's", subtract(rational(certificate.D), bound))
    sensor = scale(Fraction(plant.sensor_noise.energy), rational(plant.measurement_noise_cov))
    yield matrix_condition("N: holds the sensor noise", subtract(rational(plant.sensor_error.shape), sensor))
    first = scale(Fraction(plant.initial_noise.energy), rational(plant.initial_cov))
    yield matrix_condition(
        "r0: holds the error of the first estimate", subtract(rational(plant.initial_error.shape), first)
    )


def _error_set(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """(E0) and (E1): the error starts in E(Sigma) and never leaves it."""
    Sigma, D = rational(certificate.Sigma), rational(certificate.D)
    rate = Fraction(certificate.multipliers.error)
    yield matrix_condition("(E0) Sigma - r0^2 I >= 0", subtract(Sigma, rational(plant.initial_error.shape)))
    grown = add(scale(1 / rate, congruence(rational(plant.A), Sigma)), scale(1 / (1 - rate), D))
    yield matrix_condition("(E1) Sigma - A Sigma A'/lam_e - D/(1-lam_e) >= 0", subtract(Sigma, grown))


def _safe_set(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """(I), (S), (U): the safe set is invariant, lies in the box, and its input respects the limits."""
    shares = certificate.multipliers
    L, K, Sigma = rational(certificate.L), rational(certificate.K), rational(certificate.Sigma)
    B = rational(plant.B)
    yield matrix_condition("L > 0", L, strict=True)
    gain = multiply(B, K)
    D_u = _with_action_rounding(rational(certificate.D), B, plant.u_max, Fraction(shares.rounding))
    grown = add(
        scale(1 / Fraction(shares.state), congruence(add(rational(plant.A), gain), L)),
        scale(1 / Fraction(shares.estimate), congruence(gain, Sigma)),
        scale(1 / Fraction(shares.disturbance), D_u),
    )
    yield matrix_condition("(I) L - (A+BK) L (A+BK)'/lx - BK Sigma K'B'/le - D_u/ld >= 0", subtract(L, grown))
    for j, row in enumerate(plant.C):
        yield scalar(f"(S) c_{j + 1} L c_{j + 1}' <= 1", 1 - quadratic(rational(row), L))
    for i, (limit, share) in enumerate(zip(plant.u_max, shares.inputs, strict=True)):
        mu = Fraction(share)
        used = quadratic([K[i]], L) / mu + quadratic([K[i]], Sigma) / (1 - mu)
        allowed = (Fraction(float(limit)) * (1 - ACTION_ROUNDING)) ** 2
        yield scalar(f"(U) input {i + 1} stays within u_max (1 - 2^-24)", allowed - used)


def _with_action_rounding(D: Matrix, B: Matrix, u_max: np.ndarray, growth: Fraction) -> Matrix:
    """Returns D_u = (1+s) D + (1+1/s) m B diag((2^-24 u_max)^2) B'."""
    m = len(u_max)
    spread = [[Fraction(0)] * m for _ in range(m)]
    for i, limit in enumerate(u_max):
        spread[i][i] = m * (ACTION_ROUNDING * Fraction(float(limit))) ** 2
    return add(scale(1 + growth, D), scale(1 + 1 / growth, congruence(B, spread)))


def _trace_share(first: Matrix, second: Matrix) -> Fraction | None:
    """Returns a rational nu near the trace-optimal one (any in (0, 1) proves containment); None if a term is zero."""
    a, b = (sum(matrix[i][i] for i in range(len(matrix))) for matrix in (first, second))
    if a == 0 or b == 0:
        return None
    a, b = Fraction(float(a) ** 0.5), Fraction(float(b) ** 0.5)
    return a / (a + b)
