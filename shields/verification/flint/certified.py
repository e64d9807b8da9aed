"""The conditions of the certified method (theory.md sections 3 and 6), with denominators multiplied out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any

import numpy as np
from flint import fmpq

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.proof_data import CertifiedProof, ContractProof
from shields.verification.conditions import Condition
from shields.verification.flint.bounds import bound_conditions
from shields.verification.flint.exact import at_least_zero, definite, form, identity, is_so, mapped, matrix, number

# An action in [-1, 1] that becomes a float32 moves by at most half a unit in the last of 24 binary digits.
_FLOAT32 = fmpq(1, 2**24)


def certified_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks a certificate of method "certified"; what cannot be stated after something failed is left out."""
    proof = certificate.proof()
    fits = _fits(certificate, proof, plant)
    yield is_so("shapes: L (n, n), K (m, n), one input multiplier per input", fits)
    if not fits:
        return
    ranges = list(_range_conditions(proof))
    yield from ranges
    if not all(condition.holds for condition in ranges):
        return
    D = matrix(proof.D)
    yield from bound_conditions(D, proof.ages, plant)
    if proof.ages is None:
        Sigma, first = matrix(proof.Sigma), matrix(plant.initial_error.shape)
        yield definite("(E0) Sigma - r0^2 I >= 0", Sigma - first)
        name = "(E1) Sigma - A Sigma A'/lam_e - D/(1-lam_e) >= 0"
        yield _holds_next(name, Sigma, matrix(plant.A), Sigma, D, number(proof.multipliers.error))
    else:
        yield from _age_conditions(proof, proof.ages, D, plant)
    yield from _safe_set_conditions(certificate, proof, D, plant)


def _fits(certificate: Certificate, proof: CertifiedProof, plant: LinearPlant) -> bool:
    """Returns whether all matrices and multipliers are as many and as large as the plant needs."""
    n, m, p = plant.n, plant.m, plant.p
    shapes = [(certificate.L, (n, n)), (certificate.K, (m, n)), (proof.Sigma, (n, n)), (proof.D, (n, n))]
    if proof.ages is not None:
        steps = proof.ages.sets.contract.max_age + 1
        shapes += [(proof.ages.sets.gains, (steps, n, p)), (proof.ages.inputs, (steps, m))]
    return len(proof.multipliers.inputs) == m and all(array.shape == shape for array, shape in shapes)


def _invariance_multipliers(proof: CertifiedProof) -> list[tuple[np.ndarray, Sequence[float], Sequence[float]]]:
    """Returns error set, (lx, le, ld) and mu_i of every (I) and (U): one, or one for every age of the contract."""
    own, ages = proof.multipliers, proof.ages
    if ages is None:
        return [(proof.Sigma, (own.state, own.estimate, own.disturbance), own.inputs)]
    steps = range(ages.sets.contract.max_age + 1)
    return [(ages.sets.shapes[age], ages.multipliers[age].tolist(), ages.inputs[age].tolist()) for age in steps]


def _range_conditions(proof: CertifiedProof) -> Iterator[Condition]:
    """Checks that every multiplier lies where the inequality that uses it is true."""
    ages, s = proof.ages, proof.multipliers.rounding
    rates = [[proof.multipliers.error]] if ages is None else [ages.sets.rates.tolist(), ages.sets.multipliers.tolist()]
    between, triples = list(chain(*rates)), []
    for _, triple, inputs in _invariance_multipliers(proof):
        triples.append(triple)
        between += inputs
    finite = all(math.isfinite(value) for value in chain(between, *triples, [s]))
    yield is_so("multipliers: finite", finite)
    if not finite:
        return
    yield is_so("multipliers: 0 < lam_e < 1 and 0 < mu_i < 1", all(0 < number(value) < 1 for value in between))
    yield is_so("multipliers: lx, le, ld, s > 0", all(number(value) > 0 for value in chain(*triples, [s])))
    least = min(1 - sum(map(number, triple), fmpq(0)) for triple in triples)
    yield at_least_zero("multipliers: lx + le + ld <= 1", least)


def _holds_next(name: str, outer: Any, A: Any, inner: Any, D: Any, lam: Any) -> Condition:
    """Returns the condition outer >= A inner A'/lam + D/(1-lam), times lam (1-lam)."""
    rest = 1 - lam
    return definite(name, lam * rest * outer - rest * mapped(A, inner) - lam * D, lam * rest)


def _age_conditions(proof: CertifiedProof, ages: ContractProof, D: Any, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (C0), (C1) and (C2), and that what the certificate shows as its own is of the largest age."""
    sets, own, last = ages.sets, proof.multipliers, ages.sets.contract.max_age
    stated = [own.error, own.state, own.estimate, own.disturbance, *own.inputs]
    repeated = [sets.rates[last], *ages.multipliers[last], *ages.inputs[last]]
    same = stated == repeated and proof.Sigma.tolist() == sets.shapes[last].tolist()
    yield is_so("Sigma is the set of the largest age, with its multipliers", same)
    A, H, N, one = matrix(plant.A), matrix(plant.H), matrix(sets.noise), identity(plant.n)
    shapes = [matrix(shape) for shape in sets.shapes]
    yield definite("(C0) Sigma_0 - r0^2 I >= 0", shapes[0] - matrix(plant.initial_error.shape))
    for age in range(last + 1):
        name = f"(C1) Sigma_{age + 1} - A Sigma_{age} A'/lam - D/(1-lam) >= 0"
        yield _holds_next(name, shapes[age + 1], A, shapes[age], D, number(sets.rates[age]))
    for age in range(1, last + 2):
        T, mu = matrix(sets.gains[age - 1]), number(sets.multipliers[age - 1])
        name = f"(C2) Sigma_0 - (I-TH) Sigma_{age} (I-TH)'/mu - T N T'/(1-mu) >= 0"
        yield _holds_next(name, shapes[0], one - T * H, shapes[age], mapped(T, N), mu)


def _safe_set_conditions(
    certificate: Certificate, proof: CertifiedProof, D: Any, plant: LinearPlant
) -> Iterator[Condition]:
    """Checks (S), and (I) and (U) for every error set."""
    L, B = matrix(certificate.L), matrix(plant.B)
    K_rows = [matrix(row) for row in certificate.K]
    yield definite("L > 0", L, strictly=True)
    for j, row in enumerate(plant.C):
        yield at_least_zero(f"(S) c_{j + 1} L c_{j + 1}' <= 1", 1 - form(matrix(row), L))
    BK, s = B * matrix(certificate.K), number(proof.multipliers.rounding)
    moved = mapped(matrix(plant.A) + BK, L)
    # m B diag(r^2) B' is a sum over the columns of B; D_u times s is (1+s) (s D + that).
    rounding = 0 * D
    for i, limit in enumerate(plant.u_max):
        column = matrix(plant.B[:, i])
        rounding += plant.m * (_FLOAT32 * number(limit)) ** 2 * (column.transpose() * column)
    D_u = (1 + s) * (s * D + rounding)
    for age, (shape, triple, inputs) in enumerate(_invariance_multipliers(proof)):
        label = "" if proof.ages is None else f" at age {age}"
        Sigma, (lx, le, ld) = matrix(shape), map(number, triple)
        unit = lx * le * ld * s
        kept = unit * L - (le * ld * s) * moved - (lx * ld * s) * mapped(BK, Sigma) - (lx * le) * D_u
        yield definite(f"(I) L - (A+BK) L (A+BK)'/lx - BK Sigma K'B'/le - D_u/ld >= 0{label}", kept, unit)
        for i, (limit, row, value) in enumerate(zip(plant.u_max, K_rows, inputs, strict=True)):
            mu = number(value)
            allowed = number(limit) ** 2 * (1 - _FLOAT32) ** 2
            slack = mu * (1 - mu) * allowed - (1 - mu) * form(row, L) - mu * form(row, Sigma)
            name = f"(U) input {i + 1} stays within u_max (1 - 2^-24){label}"
            yield at_least_zero(name, slack, mu * (1 - mu))
