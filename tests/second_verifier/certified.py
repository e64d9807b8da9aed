"""The conditions of the certified method (docs/shield_proof.md), with denominators multiplied out."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from typing import Any

from flint import fmpq

from ncs_gym import Ellipsoid, LinearPlant
from shields.certificate import Certificate
from shields.verification.rational_matrix import Condition
from tests.second_verifier.bounds import bound_conditions
from tests.second_verifier.exact import (
    FLOAT32,
    at_least_zero,
    definite,
    form,
    identity,
    is_so,
    mapped,
    matrix,
    number,
)
from tests.second_verifier.polytope import polytope_conditions


def certified_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks a certificate of method "certified"; what cannot be stated after something failed is left out."""
    fits = _fits(certificate, plant)
    yield is_so("shapes: K (m, n), gains of updates (n, p), one multiplier of an ellipsoid per input", fits)
    if not fits:
        return
    S, at_rest = certificate.safe_set, certificate.resting_state.tolist()
    center = [0.0] * plant.n if isinstance(S, Ellipsoid) else S.center.tolist()
    yield is_so("S: it is around the resting point", at_rest == center)
    if at_rest != center:
        return
    if isinstance(S, Ellipsoid) and (certificate.resting_input.any() or not plant.is_symmetric):
        yield is_so("S: an ellipsoid is kept only around zero, within symmetric limits", False)
        return
    ranges = list(_range_conditions(certificate))
    yield from ranges
    if not all(condition.holds for condition in ranges):
        return
    D = matrix(certificate.D)
    yield from bound_conditions(certificate, plant)
    yield from _error_conditions(certificate, D, plant)
    if isinstance(S, Ellipsoid):
        yield from _ellipsoid_conditions(S, certificate, D, plant)
    else:
        yield from polytope_conditions(S, certificate, plant)


def _fits(certificate: Certificate, plant: LinearPlant) -> bool:
    """Returns whether all matrices and multipliers are as many and as large as the plant needs."""
    n, m, p, updates = plant.n, plant.m, plant.p, certificate.updates
    S = certificate.safe_set
    kept = (S.shape_matrix, (n, n)) if isinstance(S, Ellipsoid) else (S.rows, (len(S.rows), n))
    shapes = [kept, (certificate.K, (m, n)), (certificate.D, (n, n))]
    for proof in certificate.proofs:
        shapes.append((proof.Sigma, (n, n)))
        if proof.shares is not None and proof.inputs is not None:
            shapes += [(proof.shares, (3,)), (proof.inputs, (m,))]
    if updates is None:
        count = 1
    else:
        count = updates.contract.max_age + 1
        shapes += [(updates.gains, (count, n, p)), (updates.shares, (count,)), (updates.noise, (p, p))]
    return len(certificate.proofs) == count and all(array.shape == shape for array, shape in shapes)


def _range_conditions(certificate: Certificate) -> Iterator[Condition]:
    """Checks that every multiplier lies where the inequality that uses it is true."""
    s = [] if certificate.rounding is None else [certificate.rounding]
    between = [] if certificate.updates is None else certificate.updates.shares.tolist()
    between += [proof.rate for proof in certificate.proofs]
    between += chain.from_iterable(proof.inputs.tolist() for proof in certificate.proofs if proof.inputs is not None)
    triples = [proof.shares.tolist() for proof in certificate.proofs if proof.shares is not None]
    finite = all(math.isfinite(value) for value in chain(between, *triples, s))
    yield is_so("multipliers: finite", finite)
    if not finite:
        return
    yield is_so("multipliers: 0 < lam_e < 1 and 0 < mu_i < 1", all(0 < number(value) < 1 for value in between))
    yield is_so("multipliers: lx, le, ld, s > 0", all(number(value) > 0 for value in chain(*triples, s)))
    least = min((1 - sum(map(number, triple), fmpq(0)) for triple in triples), default=fmpq(0))
    yield at_least_zero("multipliers: lx + le + ld <= 1", least)


def _holds_next(name: str, outer: Any, A: Any, inner: Any, D: Any, lam: Any) -> Condition:
    """Returns the condition outer >= A inner A'/lam + D/(1-lam), times lam (1-lam)."""
    rest = 1 - lam
    return definite(name, lam * rest * outer - rest * mapped(A, inner) - lam * D, lam * rest)


def _error_conditions(certificate: Certificate, D: Any, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (E0) and (E1) of one error set, or (C0), (C1) and (C2) of one for every age."""
    A, updates = matrix(plant.A), certificate.updates
    sets, rates = [matrix(proof.Sigma) for proof in certificate.proofs], [proof.rate for proof in certificate.proofs]
    start = sets[0] - matrix(plant.initial_error.shape_matrix)
    if updates is None:
        yield definite("(E0) Sigma - X0 >= 0", start)
        name = "(E1) Sigma - A Sigma A'/lam_e - D/(1-lam_e) >= 0"
        yield _holds_next(name, sets[0], A, sets[0], D, number(rates[0]))
        return
    yield definite("(C0) Sigma_0 - X0 >= 0", start)
    sets.append(matrix(updates.last))
    for age, rate in enumerate(rates):
        name = f"(C1) Sigma_{age + 1} - A Sigma_{age} A'/lam - D/(1-lam) >= 0"
        yield _holds_next(name, sets[age + 1], A, sets[age], D, number(rate))
    H, N, one = matrix(plant.H), matrix(updates.noise), identity(plant.n)
    for age in range(1, len(sets)):
        T, mu = matrix(updates.gains[age - 1]), number(updates.shares[age - 1])
        name = f"(C2) Sigma_0 - (I-TH) Sigma_{age} (I-TH)'/mu - T N T'/(1-mu) >= 0"
        yield _holds_next(name, sets[0], one - T * H, sets[age], mapped(T, N), mu)


def _ellipsoid_conditions(S: Ellipsoid, certificate: Certificate, D: Any, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (S), and (I) and (U) for every error set."""
    L, B = matrix(S.shape_matrix), matrix(plant.B)
    K_rows = [matrix(row) for row in certificate.K]
    yield definite("L > 0", L, strictly=True)
    for j, row in enumerate(plant.box):
        yield at_least_zero(f"(S) c_{j + 1} L c_{j + 1}' <= 1", 1 - form(matrix(row), L))
    BK, s = B * matrix(certificate.K), number(certificate.rounding)
    moved = mapped(matrix(plant.A) + BK, L)
    # m B diag(r^2) B' is a sum over the columns of B; D_u times s is (1+s) (s D + that).
    rounding = 0 * D
    for i, limit in enumerate(plant.largest_input):
        column = matrix(plant.B[:, i])
        rounding += plant.m * (FLOAT32 * number(limit)) ** 2 * (column.transpose() * column)
    D_u = (1 + s) * (s * D + rounding)
    for age, proof in enumerate(certificate.proofs):
        assert proof.shares is not None
        assert proof.inputs is not None
        label = "" if certificate.updates is None else f" at age {age}"
        Sigma, (lx, le, ld) = matrix(proof.Sigma), map(number, proof.shares)
        unit = lx * le * ld * s
        kept = unit * L - (le * ld * s) * moved - (lx * ld * s) * mapped(BK, Sigma) - (lx * le) * D_u
        yield definite(f"(I) L - (A+BK) L (A+BK)'/lx - BK Sigma K'B'/le - D_u/ld >= 0{label}", kept, unit)
        for i, (limit, row, value) in enumerate(zip(plant.largest_input, K_rows, proof.inputs, strict=True)):
            mu = number(value)
            allowed = number(limit) ** 2 * (1 - FLOAT32) ** 2
            slack = mu * (1 - mu) * allowed - (1 - mu) * form(row, L) - mu * form(row, Sigma)
            name = f"(U) input {i + 1} stays within u_max (1 - 2^-24){label}"
            yield at_least_zero(name, slack, mu * (1 - mu))
