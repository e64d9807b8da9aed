"""Exact verification of a certificate, independent of how it was made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.uncertainty.ellipsoid import SMALLEST_SHARE
from shields.certificate import AgeProof, Certificate, CertificateError, Proof
from shields.paper.conditions import paper_conditions
from shields.verification.conditions import Condition, flag, matrix_condition, scalar
from shields.verification.rational_matrix import (
    Matrix,
    add,
    congruence,
    multiply,
    quadratic,
    rational,
    scale,
    subtract,
)

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
    proof = certificate.proof()
    conditions.append(flag("shapes: L (n, n), K (m, n), one input share per input", fits and _shares_fit(proof, plant)))
    if not conditions[-1].holds:
        return Report(tuple(conditions))
    conditions += _shares(proof)
    if all(condition.holds for condition in conditions[2:]):
        conditions += _bounds(proof, plant)
        conditions += _error_set(proof, plant) if proof.ages is None else _age_sets(proof, proof.ages, plant)
        conditions += _safe_set(certificate, proof, plant)
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


def _shares_fit(proof: Proof, plant: LinearPlant) -> bool:
    if len(proof.multipliers.inputs) != plant.m:
        return False
    if proof.ages is None:
        return True
    sets = proof.ages.sets
    return sets.gains.shape[1:] == (plant.n, plant.p) and proof.ages.inputs.shape[1] == plant.m


def _shares(proof: Proof) -> Iterator[Condition]:
    """Checks the ranges of all multipliers."""
    shares, ages = proof.multipliers, proof.ages
    rates = [shares.error] if ages is None else [*ages.sets.rates, *ages.sets.shares]
    proofs = _invariance_proofs(proof)
    inputs = [share for each in proofs for share in each.inputs]
    parts = [[float(share) for share in each.shares] for each in proofs]
    finite = bool(np.isfinite([*rates, *inputs, shares.rounding]).all() and np.isfinite(parts).all())
    yield flag("multipliers: finite", finite)
    if not finite:
        return
    inside = all(0.0 < share < 1.0 for share in (*rates, *inputs))
    yield flag("multipliers: 0 < lam_e < 1 and 0 < mu_i < 1", inside)
    exact = [[Fraction(share) for share in part] for part in parts]
    positive = min(*(min(part) for part in exact), Fraction(shares.rounding)) > 0
    yield flag("multipliers: lx, le, ld, s > 0", positive)
    yield scalar("multipliers: lx + le + ld <= 1", min(1 - sum(part, Fraction(0)) for part in exact))


def _bounds(proof: Proof, plant: LinearPlant) -> Iterator[Condition]:
    """Checks that D, N and r0^2 I contain what theory.md section 1 says."""
    identity = rational(np.eye(plant.n))
    noise = rational(plant.process_noise_cov)
    energy = Fraction(plant.process_noise.energy)
    ball = scale(Fraction(plant.gamma), identity)
    ellipsoid = scale(energy, noise)
    need = _sum_bound(ball, ellipsoid, rational(plant.relative_weight))
    bound = rational(plant.disturbance.shape)
    yield matrix_condition("D: the plant's holds the disturbance and the process noise", subtract(bound, need))
    yield matrix_condition("D: the certificate's holds the plant's", subtract(rational(proof.D), bound))
    sensor = scale(Fraction(plant.sensor_noise.energy), rational(plant.measurement_noise_cov))
    if proof.ages is None:
        yield matrix_condition("N: holds the sensor noise", subtract(rational(plant.sensor_error.shape), sensor))
    else:
        sets = proof.ages.sets
        step = Fraction(sets.contract.quantization_step)
        ball = scale(plant.p * step * step / 4, rational(np.eye(plant.p)))
        need = _sum_bound(ball, sensor, rational(np.eye(plant.p)))
        yield matrix_condition("N: holds the sensor noise and the rounding", subtract(rational(sets.noise), need))
    first = scale(Fraction(plant.initial_noise.energy), rational(plant.initial_cov))
    yield matrix_condition(
        "r0: holds the error of the first estimate", subtract(rational(plant.initial_error.shape), first)
    )


def _error_set(proof: Proof, plant: LinearPlant) -> Iterator[Condition]:
    """(E0) and (E1): the error starts in E(Sigma) and never leaves it."""
    Sigma, D = rational(proof.Sigma), rational(proof.D)
    rate = Fraction(proof.multipliers.error)
    yield matrix_condition("(E0) Sigma - r0^2 I >= 0", subtract(Sigma, rational(plant.initial_error.shape)))
    grown = add(scale(1 / rate, congruence(rational(plant.A), Sigma)), scale(1 / (1 - rate), D))
    yield matrix_condition("(E1) Sigma - A Sigma A'/lam_e - D/(1-lam_e) >= 0", subtract(Sigma, grown))


def _age_sets(proof: Proof, ages: AgeProof, plant: LinearPlant) -> Iterator[Condition]:
    """(C0), (C1) and (C2): under the contract the error of every age stays in the set of that age."""
    sets, identity = ages.sets, rational(np.eye(plant.n))
    A, H, D, N = (rational(matrix) for matrix in (plant.A, plant.H, proof.D, sets.noise))
    shapes = [rational(shape) for shape in sets.shapes]
    oldest = sets.contract.max_age
    last = proof.multipliers
    same = np.array_equal(proof.Sigma, sets.shapes[oldest]) and last.error == sets.rates[-1]
    same &= (last.state, last.estimate, last.disturbance) == tuple(ages.shares[-1])
    same &= tuple(last.inputs) == tuple(ages.inputs[-1])
    yield flag("Sigma is the set of the largest age, with its multipliers", same)
    yield matrix_condition("(C0) Sigma_0 - r0^2 I >= 0", subtract(shapes[0], rational(plant.initial_error.shape)))
    for j, rate in enumerate(map(Fraction, sets.rates)):
        grown = add(scale(1 / rate, congruence(A, shapes[j])), scale(1 / (1 - rate), D))
        name = f"(C1) Sigma_{j + 1} - A Sigma_{j} A'/lam - D/(1-lam) >= 0"
        yield matrix_condition(name, subtract(shapes[j + 1], grown))
    for j, (gain, share) in enumerate(zip(sets.gains, map(Fraction, sets.shares), strict=True), start=1):
        T = rational(gain)
        kept = congruence(subtract(identity, multiply(T, H)), shapes[j])
        updated = add(scale(1 / share, kept), scale(1 / (1 - share), congruence(T, N)))
        name = f"(C2) Sigma_0 - (I-TH) Sigma_{j} (I-TH)'/mu - T N T'/(1-mu) >= 0"
        yield matrix_condition(name, subtract(shapes[0], updated))


class _InvarianceProof(NamedTuple):
    """Shares that prove (I) and (U) for one error set: a label, Sigma, (lx, le, ld) and mu."""

    label: str
    Sigma: np.ndarray
    shares: Sequence[float]
    inputs: Sequence[float]


def _invariance_proofs(proof: Proof) -> list[_InvarianceProof]:
    """Returns one proof per error set: one in all, or under a contract one per age."""
    shares, ages = proof.multipliers, proof.ages
    if ages is None:
        parts = (shares.state, shares.estimate, shares.disturbance)
        return [_InvarianceProof("", proof.Sigma, parts, shares.inputs)]
    rows = zip(ages.sets.shapes[:-1], ages.shares, ages.inputs, strict=True)
    return [_InvarianceProof(f" at age {j}", *row) for j, row in enumerate(rows)]


def _safe_set(certificate: Certificate, proof: Proof, plant: LinearPlant) -> Iterator[Condition]:
    """(I), (S), (U): the safe set is invariant, lies in the box, and its input respects the limits."""
    L, K, B = rational(certificate.L), rational(certificate.K), rational(plant.B)
    yield matrix_condition("L > 0", L, strict=True)
    gain, growth = multiply(B, K), Fraction(proof.multipliers.rounding)
    D_u = _with_action_rounding(rational(proof.D), B, plant.u_max, growth)
    moved = congruence(add(rational(plant.A), gain), L)
    for j, row in enumerate(plant.C):
        yield scalar(f"(S) c_{j + 1} L c_{j + 1}' <= 1", 1 - quadratic(rational(row), L))
    for each in _invariance_proofs(proof):
        Sigma = rational(each.Sigma)
        state, estimate, disturbance = (Fraction(float(share)) for share in each.shares)
        grown = add(scale(1 / state, moved), scale(1 / estimate, congruence(gain, Sigma)), scale(1 / disturbance, D_u))
        name = f"(I) L - (A+BK) L (A+BK)'/lx - BK Sigma K'B'/le - D_u/ld >= 0{each.label}"
        yield matrix_condition(name, subtract(L, grown))
        for i, (limit, share) in enumerate(zip(plant.u_max, each.inputs, strict=True)):
            mu = Fraction(float(share))
            used = quadratic([K[i]], L) / mu + quadratic([K[i]], Sigma) / (1 - mu)
            allowed = (Fraction(float(limit)) * (1 - ACTION_ROUNDING)) ** 2
            yield scalar(f"(U) input {i + 1} stays within u_max (1 - 2^-24){each.label}", allowed - used)


def _with_action_rounding(D: Matrix, B: Matrix, u_max: np.ndarray, growth: Fraction) -> Matrix:
    """Returns D_u = (1+s) D + (1+1/s) m B diag((2^-24 u_max)^2) B'."""
    m = len(u_max)
    spread = [[Fraction(0)] * m for _ in range(m)]
    for i, limit in enumerate(u_max):
        spread[i][i] = m * (ACTION_ROUNDING * Fraction(float(limit))) ** 2
    return add(scale(1 + growth, D), scale(1 + 1 / growth, congruence(B, spread)))


def _sum_bound(first: Matrix, second: Matrix, weight: Matrix) -> Matrix:
    """Returns a shape around E(first) + E(second): P1/nu + P2/(1-nu), or the sum if one of them is zero."""
    share = _trace_share(first, second, weight)
    return add(first, second) if share is None else add(scale(1 / share, first), scale(1 / (1 - share), second))


def _trace_share(first: Matrix, second: Matrix, weight: Matrix) -> Fraction | None:
    """Returns a rational nu near the one of the smallest tr(W P) (any in (0, 1) proves containment).

    None if a term is zero.
    """
    a, b = (float(_trace(multiply(weight, matrix))) ** 0.5 for matrix in (first, second))
    if not (any(map(any, first)) and any(map(any, second))):
        return None
    share = Fraction(a) / (Fraction(a) + Fraction(b)) if a + b > 0.0 else Fraction(1, 2)
    return min(max(share, Fraction(SMALLEST_SHARE)), 1 - Fraction(SMALLEST_SHARE))


def _trace(matrix: Matrix) -> Fraction:
    return sum((matrix[i][i] for i in range(len(matrix))), Fraction(0))
