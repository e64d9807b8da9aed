"""The conditions of the certified method (docs/shield_proof.md), evaluated in rational arithmetic."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction

import numpy as np

from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.ellipsoid import SMALLEST_MULTIPLIER
from shields.certificate import Certificate, Updates
from shields.verification.polytope_conditions import polytope_conditions
from shields.verification.rational_matrix import (
    ACTION_ROUNDING,
    Condition,
    Matrix,
    add,
    congruence,
    flag,
    matrix_condition,
    multiply,
    quadratic,
    rational,
    scalar_condition,
    scale,
    subtract,
)


def certified_conditions(certificate: Certificate, plant: LinearPlant) -> list[Condition]:
    """Returns all conditions; only those of shapes or multipliers where these are wrong: others prove nothing then."""
    updates = certificate.updates
    S = certificate.safe_set
    fits = S.dim == plant.n and certificate.K.shape == (plant.m, plant.n)
    fits = fits and all(proof.inputs is None or len(proof.inputs) == plant.m for proof in certificate.proofs)
    fits = fits and (updates is None or updates.gains.shape[1:] == (plant.n, plant.p))
    conditions = [flag("shapes: K (m, n), gains of updates (n, p), one multiplier of an ellipsoid per input", fits)]
    if not fits:
        return conditions
    center = np.zeros(plant.n) if isinstance(S, Ellipsoid) else S.center
    is_around = np.array_equal(certificate.resting_state, center)
    conditions.append(flag("S: it is around the resting point", is_around))
    if not is_around:
        return conditions
    if isinstance(S, Ellipsoid) and not (plant.is_symmetric and not certificate.resting_input.any()):
        return [*conditions, flag("S: an ellipsoid is kept only around zero, within symmetric limits", False)]
    conditions += _multiplier_conditions(certificate)
    if all(condition.holds for condition in conditions):
        conditions += _bound_conditions(certificate, plant)
        conditions += _error_conditions(certificate, plant)
        if isinstance(S, Ellipsoid):
            conditions += _ellipsoid_conditions(S, certificate, plant)
        else:
            conditions += polytope_conditions(S, certificate, plant)
    return conditions


def _multiplier_conditions(certificate: Certificate) -> Iterator[Condition]:
    proofs, rounding = certificate.proofs, [] if certificate.rounding is None else [certificate.rounding]
    fractions = [proof.rate for proof in proofs]
    fractions += [mu for proof in proofs if proof.inputs is not None for mu in proof.inputs.tolist()]
    if certificate.updates is not None:
        fractions += certificate.updates.shares.tolist()
    triples = [proof.shares.tolist() for proof in proofs if proof.shares is not None]
    finite = bool(np.isfinite([*fractions, *rounding]).all() and np.isfinite(triples).all())
    yield flag("multipliers: finite", finite)
    if not finite:
        return
    inside = all(0.0 < multiplier < 1.0 for multiplier in fractions)
    yield flag("multipliers: 0 < lam_e < 1 and 0 < mu_i < 1", inside)
    exact = [[Fraction(share) for share in shares] for shares in triples]
    positive = all(each > 0 for each in (*rounding, *(min(shares) for shares in exact)))
    yield flag("multipliers: lx, le, ld, s > 0", positive)
    smallest_margin = min((1 - sum(shares, Fraction(0)) for shares in exact), default=Fraction(0))
    yield scalar_condition("multipliers: lx + le + ld <= 1", smallest_margin)


def _bound_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks that D, N and X0 contain what docs/shield_proof.md, "Setting", says they contain."""
    ball = scale(Fraction(plant.gamma), rational(np.eye(plant.n)))
    noise = scale(Fraction(plant.process_noise.energy), rational(plant.process_noise.covariance))
    weight = rational(plant.relative_weight)
    required = _with_declared(_sum_bound(ball, noise, weight), plant.of_disturbance.bound, weight)
    required = _with_declared(required, plant.remainder_bound, weight)
    bound, D = rational(plant.disturbance.shape_matrix), certificate.D
    yield matrix_condition("D: the plant's holds the disturbance and the process noise", subtract(bound, required))
    bound = _sum_bound(bound, _restlessness(certificate, plant), weight)
    yield matrix_condition("D: the certificate's holds the plant's", subtract(rational(D), bound))
    identity = rational(np.eye(plant.p))
    sensor = scale(Fraction(plant.sensor_noise.energy), rational(plant.sensor_noise.covariance))
    sensor = _with_declared(sensor, plant.of_sensor.bound, identity)
    if certificate.updates is None:
        yield matrix_condition("N: holds the sensor noise", subtract(rational(plant.sensor_error.shape_matrix), sensor))
    else:
        step = Fraction(certificate.updates.contract.quantization_step)
        required = _sum_bound(scale(plant.p * step * step / 4, identity), sensor, identity)
        difference = subtract(rational(certificate.updates.noise), required)
        yield matrix_condition("N: holds the sensor noise and the quantization error", difference)
    first = scale(Fraction(plant.initial_noise.energy), rational(plant.initial_noise.covariance))
    first = _with_declared(first, plant.of_first_error.bound, weight)
    yield matrix_condition(
        "X0: holds the error of the first estimate", subtract(rational(plant.initial_error.shape_matrix), first)
    )


def _restlessness(certificate: Certificate, plant: LinearPlant) -> Matrix:
    """Returns the shape r r' of what the resting point lacks of an equilibrium, r = A x_c + B u_c - x_c."""
    x_c, u_c = (rational(point)[0] for point in (certificate.resting_state, certificate.resting_input))
    r = [
        sum((a * x for a, x in zip(row, x_c, strict=True)), Fraction(0))
        + sum((b * u for b, u in zip(pushed, u_c, strict=True)), Fraction(0))
        - x
        for row, pushed, x in zip(rational(plant.A), rational(plant.B), x_c, strict=True)
    ]
    return [[a * b for b in r] for a in r]


def _error_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (E0) and (E1), or (C0), (C1) and (C2): the estimation error is always in the set of its age."""
    D, A = rational(certificate.D), rational(plant.A)
    shapes = [rational(proof.Sigma) for proof in certificate.proofs]
    next_shapes = [rational(shape) for shape in certificate.next_error_shapes]
    is_by_age = certificate.updates is not None
    name = "(C0) Sigma_0 - X0 >= 0" if is_by_age else "(E0) Sigma - X0 >= 0"
    yield matrix_condition(name, subtract(shapes[0], rational(plant.initial_error.shape_matrix)))
    for j, (proof, Sigma, following) in enumerate(zip(certificate.proofs, shapes, next_shapes, strict=True)):
        lam = Fraction(proof.rate)
        predicted = add(scale(1 / lam, congruence(A, Sigma)), scale(1 / (1 - lam), D))
        by_age = f"(C1) Sigma_{j + 1} - A Sigma_{j} A'/lam - D/(1-lam) >= 0"
        name = by_age if is_by_age else "(E1) Sigma - A Sigma A'/lam_e - D/(1-lam_e) >= 0"
        yield matrix_condition(name, subtract(following, predicted))
    if certificate.updates is not None:
        yield from _update_conditions(certificate.updates, shapes[0], next_shapes, plant)


def _update_conditions(
    updates: Updates, first: Matrix, shapes: Sequence[Matrix], plant: LinearPlant
) -> Iterator[Condition]:
    """Checks (C2): an update leads errors in the set of any age, Sigma_1 .. Sigma_{h+1}, into the first set."""
    identity, H, N = rational(np.eye(plant.n)), rational(plant.H), rational(updates.noise)
    for j, (Sigma, gain, share) in enumerate(zip(shapes, updates.gains, updates.shares, strict=True), start=1):
        T, mu = rational(gain), Fraction(float(share))
        kept = congruence(subtract(identity, multiply(T, H)), Sigma)
        updated = add(scale(1 / mu, kept), scale(1 / (1 - mu), congruence(T, N)))
        name = f"(C2) Sigma_0 - (I-TH) Sigma_{j} (I-TH)'/mu - T N T'/(1-mu) >= 0"
        yield matrix_condition(name, subtract(first, updated))


def _ellipsoid_conditions(S: Ellipsoid, certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (I), (S), (U): the ellipsoid is invariant and in the box, and the fallback respects the input limits."""
    L, K, B = rational(S.shape_matrix), rational(certificate.K), rational(plant.B)
    yield matrix_condition("L > 0", L, strict=True)
    BK, D, s = multiply(B, K), certificate.D, certificate.rounding
    assert s is not None  # of a certificate with an ellipsoid
    D_u = _with_action_rounding(rational(D), B, plant.largest_input, Fraction(s))
    closed_loop = congruence(add(rational(plant.A), BK), L)
    for j, row in enumerate(plant.box):
        yield scalar_condition(f"(S) c_{j + 1} L c_{j + 1}' <= 1", 1 - quadratic(rational(row), L))
    for age, proof in enumerate(certificate.proofs):
        label = "" if certificate.updates is None else f" at age {age}"
        assert proof.shares is not None
        assert proof.inputs is not None
        Sigma, (lx, le, ld) = rational(proof.Sigma), map(Fraction, proof.shares.tolist())
        successors = add(scale(1 / lx, closed_loop), scale(1 / le, congruence(BK, Sigma)), scale(1 / ld, D_u))
        name = f"(I) L - (A+BK) L (A+BK)'/lx - BK Sigma K'B'/le - D_u/ld >= 0{label}"
        yield matrix_condition(name, subtract(L, successors))
        for i, (limit, mu) in enumerate(zip(plant.largest_input, map(Fraction, proof.inputs.tolist()), strict=True)):
            used = quadratic([K[i]], L) / mu + quadratic([K[i]], Sigma) / (1 - mu)
            allowed = (Fraction(float(limit)) * (1 - ACTION_ROUNDING)) ** 2
            yield scalar_condition(f"(U) input {i + 1} stays within u_max (1 - 2^-24){label}", allowed - used)


def _with_action_rounding(D: Matrix, B: Matrix, u_max: np.ndarray, s: Fraction) -> Matrix:
    """Returns D_u = (1+s) D + (1+1/s) m B diag((2^-24 u_max)^2) B'."""
    m = len(u_max)
    rounding = [[Fraction(0)] * m for _ in range(m)]
    for i, limit in enumerate(u_max):
        rounding[i][i] = m * (ACTION_ROUNDING * Fraction(float(limit))) ** 2
    return add(scale(1 + s, D), scale(1 + 1 / s, congruence(B, rounding)))


def _with_declared(first: Matrix, declared: Ellipsoid | None, weight: Matrix) -> Matrix:
    """Returns a shape around E(first) plus a declared bound, if there is one."""
    return first if declared is None else _sum_bound(first, rational(declared.shape_matrix), weight)


def _sum_bound(first: Matrix, second: Matrix, weight: Matrix) -> Matrix:
    """Returns a shape around E(first) + E(second): P1/nu + P2/(1-nu), or P1 + P2 if one of them is zero."""
    if not (any(map(any, first)) and any(map(any, second))):
        return add(first, second)
    nu = _smallest_trace_multiplier(first, second, weight)
    return add(scale(1 / nu, first), scale(1 / (1 - nu), second))


def _smallest_trace_multiplier(first: Matrix, second: Matrix, weight: Matrix) -> Fraction:
    """Returns a rational nu near the minimizer of tr(W P); every nu in (0, 1) proves containment."""
    traces = (sum(row[i] for i, row in enumerate(multiply(weight, matrix))) for matrix in (first, second))
    a, b = map(math.sqrt, traces)
    nu = Fraction(a) / (Fraction(a) + Fraction(b)) if a + b > 0.0 else Fraction(1, 2)
    return min(max(nu, Fraction(SMALLEST_MULTIPLIER)), 1 - Fraction(SMALLEST_MULTIPLIER))
