"""The conditions of the certified method (theory.md sections 1, 3 and 6), evaluated in rational arithmetic."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.uncertainty.shape_matrices import SMALLEST_MULTIPLIER
from shields.certificate import Certificate
from shields.proof_data import CertifiedProof, ContractProof
from shields.verification.conditions import Condition, flag, matrix_condition, scalar_condition
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

# Rounding an action in [-1, 1] to float32 changes it by at most this.
ACTION_ROUNDING = Fraction(1, 2**24)


def certified_conditions(certificate: Certificate, plant: LinearPlant) -> list[Condition]:
    """Returns all conditions for a certificate whose shapes fit the plant.

    Unless the multipliers are in their ranges, only their conditions are returned: the others prove nothing then.
    """
    proof = certificate.proof()
    conditions = list(_multiplier_conditions(proof))
    if all(condition.holds for condition in conditions):
        conditions += _bound_conditions(proof, plant)
        ages = proof.ages
        conditions += _error_conditions(proof, plant) if ages is None else _age_conditions(proof, ages, plant)
        conditions += _safe_set_conditions(certificate, proof, plant)
    return conditions


def multipliers_fit(proof: CertifiedProof, plant: LinearPlant) -> bool:
    """Returns whether a proof has one multiplier per input, and under a contract gains of the plant's shape."""
    if len(proof.multipliers.inputs) != plant.m:
        return False
    if proof.ages is None:
        return True
    return proof.ages.sets.gains.shape[1:] == (plant.n, plant.p) and proof.ages.inputs.shape[1] == plant.m


def _multiplier_conditions(proof: CertifiedProof) -> Iterator[Condition]:
    """Checks the ranges of all multipliers."""
    ages, rounding = proof.ages, proof.multipliers.rounding
    rates = [proof.multipliers.error] if ages is None else [*ages.sets.rates, *ages.sets.multipliers]
    proofs = _invariance_proofs(proof)
    inputs = [mu for each in proofs for mu in each.inputs]
    triples = [[float(multiplier) for multiplier in each.multipliers] for each in proofs]
    finite = bool(np.isfinite([*rates, *inputs, rounding]).all() and np.isfinite(triples).all())
    yield flag("multipliers: finite", finite)
    if not finite:
        return
    inside = all(0.0 < multiplier < 1.0 for multiplier in (*rates, *inputs))
    yield flag("multipliers: 0 < lam_e < 1 and 0 < mu_i < 1", inside)
    exact = [[Fraction(multiplier) for multiplier in triple] for triple in triples]
    positive = min(*(min(triple) for triple in exact), Fraction(rounding)) > 0
    yield flag("multipliers: lx, le, ld, s > 0", positive)
    smallest_slack = min(1 - sum(triple, Fraction(0)) for triple in exact)
    yield scalar_condition("multipliers: lx + le + ld <= 1", smallest_slack)


def _bound_conditions(proof: CertifiedProof, plant: LinearPlant) -> Iterator[Condition]:
    """Checks that D, N and r0^2 I contain what theory.md section 1 says they contain."""
    ball = scale(Fraction(plant.gamma), rational(np.eye(plant.n)))
    noise = scale(Fraction(plant.process_noise.energy), rational(plant.process_noise_cov))
    weight = rational(plant.relative_weight)
    required = _with_declared(_sum_bound(ball, noise, weight), plant.disturbance_bound, weight)
    required = _with_declared(required, plant.remainder_bound, weight)
    bound = rational(plant.disturbance.shape)
    yield matrix_condition("D: the plant's holds the disturbance and the process noise", subtract(bound, required))
    yield matrix_condition("D: the certificate's holds the plant's", subtract(rational(proof.D), bound))
    identity = rational(np.eye(plant.p))
    sensor = scale(Fraction(plant.sensor_noise.energy), rational(plant.measurement_noise_cov))
    sensor = _with_declared(sensor, plant.sensor_bound, identity)
    if proof.ages is None:
        yield matrix_condition("N: holds the sensor noise", subtract(rational(plant.sensor_error.shape), sensor))
    else:
        step = Fraction(proof.ages.sets.contract.quantization_step)
        required = _sum_bound(scale(plant.p * step * step / 4, identity), sensor, identity)
        slack = subtract(rational(proof.ages.sets.noise), required)
        yield matrix_condition("N: holds the sensor noise and the quantization error", slack)
    first = _first_error(plant, weight)
    yield matrix_condition(
        "r0: holds the error of the first estimate", subtract(rational(plant.initial_error.shape), first)
    )


def _first_error(plant: LinearPlant, weight: Matrix) -> Matrix:
    """Returns a shape that holds the truncated first error plus the declared one.

    Its multiplier is the one that is best for the ball of radius r0, with which the plant's own bound is made; any
    multiplier proves containment.
    """
    noise = scale(Fraction(plant.initial_noise.energy), rational(plant.initial_cov))
    if plant.initial_bound is None:
        return noise
    declared = rational(plant.initial_bound.shape)
    ball = scale(Fraction(plant.initial_radius_squared), rational(np.eye(plant.n)))
    if not (any(map(any, noise)) and any(map(any, declared))):
        return add(noise, declared)
    nu = _smallest_trace_multiplier(ball, declared, weight)
    return add(scale(1 / nu, noise), scale(1 / (1 - nu), declared))


def _error_conditions(proof: CertifiedProof, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (E0) and (E1): the estimation error starts in E(Sigma) and never leaves it."""
    Sigma, D = rational(proof.Sigma), rational(proof.D)
    lam = Fraction(proof.multipliers.error)
    yield matrix_condition("(E0) Sigma - r0^2 I >= 0", subtract(Sigma, rational(plant.initial_error.shape)))
    predicted = add(scale(1 / lam, congruence(rational(plant.A), Sigma)), scale(1 / (1 - lam), D))
    yield matrix_condition("(E1) Sigma - A Sigma A'/lam_e - D/(1-lam_e) >= 0", subtract(Sigma, predicted))


def _age_conditions(proof: CertifiedProof, ages: ContractProof, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (C0), (C1) and (C2): under the contract the error at every age stays in the set of that age."""
    sets, identity = ages.sets, rational(np.eye(plant.n))
    A, H, D, N = (rational(matrix) for matrix in (plant.A, plant.H, proof.D, sets.noise))
    shapes = [rational(shape) for shape in sets.shapes]
    yield flag("Sigma is the set of the largest age, with its multipliers", _repeats_last_age(proof, ages))
    yield matrix_condition("(C0) Sigma_0 - r0^2 I >= 0", subtract(shapes[0], rational(plant.initial_error.shape)))
    for j, lam in enumerate(map(Fraction, sets.rates)):
        predicted = add(scale(1 / lam, congruence(A, shapes[j])), scale(1 / (1 - lam), D))
        name = f"(C1) Sigma_{j + 1} - A Sigma_{j} A'/lam - D/(1-lam) >= 0"
        yield matrix_condition(name, subtract(shapes[j + 1], predicted))
    for j, (gain, mu) in enumerate(zip(sets.gains, map(Fraction, sets.multipliers), strict=True), start=1):
        T = rational(gain)
        kept = congruence(subtract(identity, multiply(T, H)), shapes[j])
        updated = add(scale(1 / mu, kept), scale(1 / (1 - mu), congruence(T, N)))
        name = f"(C2) Sigma_0 - (I-TH) Sigma_{j} (I-TH)'/mu - T N T'/(1-mu) >= 0"
        yield matrix_condition(name, subtract(shapes[0], updated))


def _repeats_last_age(proof: CertifiedProof, ages: ContractProof) -> bool:
    """Returns whether the certificate's own Sigma and multipliers are those of the contract's largest age."""
    last = proof.multipliers
    return (
        np.array_equal(proof.Sigma, ages.sets.shapes[ages.sets.contract.max_age])
        and bool(last.error == ages.sets.rates[-1])
        and (last.state, last.estimate, last.disturbance) == tuple(ages.multipliers[-1])
        and tuple(last.inputs) == tuple(ages.inputs[-1])
    )


class _InvarianceProof(NamedTuple):
    """The multipliers (lx, le, ld) and mu that prove (I) and (U) for one error set E(Sigma)."""

    label: str
    Sigma: np.ndarray
    multipliers: Sequence[float]
    inputs: Sequence[float]


def _invariance_proofs(proof: CertifiedProof) -> list[_InvarianceProof]:
    """Returns one proof per error set: a single one, or under a contract one per age."""
    own, ages = proof.multipliers, proof.ages
    if ages is None:
        return [_InvarianceProof("", proof.Sigma, (own.state, own.estimate, own.disturbance), own.inputs)]
    rows = zip(ages.sets.shapes[:-1], ages.multipliers, ages.inputs, strict=True)
    return [_InvarianceProof(f" at age {j}", *row) for j, row in enumerate(rows)]


def _safe_set_conditions(certificate: Certificate, proof: CertifiedProof, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (I), (S), (U): the safe set is invariant and in the box, and the fallback respects the input limits."""
    L, K, B = rational(certificate.L), rational(certificate.K), rational(plant.B)
    yield matrix_condition("L > 0", L, strict=True)
    BK = multiply(B, K)
    D_u = _with_action_rounding(rational(proof.D), B, plant.u_max, Fraction(proof.multipliers.rounding))
    closed_loop = congruence(add(rational(plant.A), BK), L)
    for j, row in enumerate(plant.C):
        yield scalar_condition(f"(S) c_{j + 1} L c_{j + 1}' <= 1", 1 - quadratic(rational(row), L))
    for each in _invariance_proofs(proof):
        Sigma = rational(each.Sigma)
        lx, le, ld = (Fraction(float(multiplier)) for multiplier in each.multipliers)
        successors = add(scale(1 / lx, closed_loop), scale(1 / le, congruence(BK, Sigma)), scale(1 / ld, D_u))
        name = f"(I) L - (A+BK) L (A+BK)'/lx - BK Sigma K'B'/le - D_u/ld >= 0{each.label}"
        yield matrix_condition(name, subtract(L, successors))
        for i, (limit, multiplier) in enumerate(zip(plant.u_max, each.inputs, strict=True)):
            mu = Fraction(float(multiplier))
            used = quadratic([K[i]], L) / mu + quadratic([K[i]], Sigma) / (1 - mu)
            allowed = (Fraction(float(limit)) * (1 - ACTION_ROUNDING)) ** 2
            yield scalar_condition(f"(U) input {i + 1} stays within u_max (1 - 2^-24){each.label}", allowed - used)


def _with_action_rounding(D: Matrix, B: Matrix, u_max: np.ndarray, s: Fraction) -> Matrix:
    """Returns D_u = (1+s) D + (1+1/s) m B diag((2^-24 u_max)^2) B'."""
    m = len(u_max)
    rounding = [[Fraction(0)] * m for _ in range(m)]
    for i, limit in enumerate(u_max):
        rounding[i][i] = m * (ACTION_ROUNDING * Fraction(float(limit))) ** 2
    return add(scale(1 + s, D), scale(1 + 1 / s, congruence(B, rounding)))


def _with_declared(first: Matrix, declared: Ellipsoid | None, weight: Matrix) -> Matrix:
    """Returns a shape around E(first) plus a declared bound, if there is one."""
    return first if declared is None else _sum_bound(first, rational(declared.shape), weight)


def _sum_bound(first: Matrix, second: Matrix, weight: Matrix) -> Matrix:
    """Returns a shape around E(first) + E(second): P1/nu + P2/(1-nu), or P1 + P2 if one of them is zero."""
    if not (any(map(any, first)) and any(map(any, second))):
        return add(first, second)
    nu = _smallest_trace_multiplier(first, second, weight)
    return add(scale(1 / nu, first), scale(1 / (1 - nu), second))


def _smallest_trace_multiplier(first: Matrix, second: Matrix, weight: Matrix) -> Fraction:
    """Returns a rational nu near the minimizer of tr(W P); every nu in (0, 1) proves containment."""
    a, b = (math.sqrt(_trace(multiply(weight, matrix))) for matrix in (first, second))
    nu = Fraction(a) / (Fraction(a) + Fraction(b)) if a + b > 0.0 else Fraction(1, 2)
    return min(max(nu, Fraction(SMALLEST_MULTIPLIER)), 1 - Fraction(SMALLEST_MULTIPLIER))


def _trace(matrix: Matrix) -> Fraction:
    """Returns the trace."""
    return sum((matrix[i][i] for i in range(len(matrix))), Fraction(0))
