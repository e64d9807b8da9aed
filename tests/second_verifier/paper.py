"""The constraints of OP (Liu et al. Definition 4) for a given set and gain, with its constants in ball arithmetic."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from flint import arb, ctx, fmpq, fmpq_mat

from ncs_gym import LinearPlant
from shields.paper import PaperCertificate
from shields.verification.rational_matrix import Condition
from tests.second_verifier.bounds import keeps_enough
from tests.second_verifier.exact import (
    PRECISION,
    at_least_zero,
    definite,
    form,
    identity,
    is_so,
    mapped,
    matrix,
    number,
)

# Where 1 - kappa rho is smaller, Theorem 2 bounds nothing.
_SMALLEST_GAP = 1e-9
# The constants that a certificate states are floats: they may differ from the true ones by this, relative to them.
_STATED = fmpq(1, 10**9)


def paper_conditions(certificate: PaperCertificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (C1)-(C7); U and tau are eliminated from (C4)-(C6) as docs/paper.md says."""
    fits = certificate.L.shape == (plant.n, plant.n) and certificate.K.shape == (plant.m, plant.n)
    yield is_so("shapes: L (n, n), K (m, n)", fits)
    if not fits:
        return
    ends = np.concatenate([plant.box_ends, plant.input_ends / plant.input_ends[1]], axis=1)
    if (
        np.abs(ends).tolist() != np.ones_like(ends).tolist()
        or len(plant.mixed_rows)
        or plant.between_samples is not None
    ):
        yield is_so("limits: the paper's theorems know |c_j x| <= 1 and |u_i| <= u_max_i alone", False)
        return
    for bound in (plant.of_disturbance.bound, plant.remainder_bound, plant.of_sensor.bound, plant.of_first_error.bound):
        if bound is not None and np.any(bound.shape_matrix):
            yield is_so("bounds: the paper's theorems know gamma and covariances alone", False)
            return
    kappa, rho = number(certificate.kappa), number(certificate.rho)
    inside = kappa > 0 and rho >= 1 and 1 - kappa * rho >= number(_SMALLEST_GAP)
    yield is_so("0 < kappa, 1 <= rho, kappa rho < 1", bool(inside))
    if not inside:
        return
    with ctx.workprec(PRECISION):
        epsilon_up, epsilon, alpha = _constants(kappa, rho, plant)
        agree = _is_near(certificate.epsilon_up, epsilon_up) and _is_near(certificate.epsilon, epsilon)
        yield is_so("eps_up and eps are those of Theorems 2 and 3", agree)
    yield keeps_enough("chi-square: no more than delta is truncated", plant.process_noise, plant)
    yield from _set_conditions(certificate, kappa, rho, epsilon_up, alpha, plant)


def _set_conditions(
    certificate: PaperCertificate, kappa: Any, rho: Any, epsilon_up: Any, alpha: Any, plant: LinearPlant
) -> Iterator[Condition]:
    """Checks the constraints on L and K, given enclosures of the constants."""
    L, K, n = matrix(certificate.L), matrix(certificate.K), plant.n
    positive = definite("L > 0", L, strictly=True)
    yield positive
    if positive.holds:  # then the block matrix of (C1) is semidefinite exactly if this Schur complement is
        closed_loop, M = matrix(plant.A) + matrix(plant.B) * K, L.inv()
        yield definite("(C1) kappa M - (A+BK)' M (A+BK) >= 0", kappa * M - mapped(closed_loop.transpose(), M))
    with ctx.workprec(PRECISION):
        least = alpha.upper().fmpq()
    yield definite("(C2) L >= alpha I", L - least * identity(n))
    for j, row in enumerate(plant.box):
        yield at_least_zero(f"(C3) c_{j + 1} L c_{j + 1}' <= 1", 1 - form(matrix(row), L))
    for i, limit in enumerate(plant.largest_input):
        row = matrix(certificate.K[i])
        slack = number(limit) ** 2 / 2 - form(row, L)
        if alpha > 0:
            with ctx.workprec(PRECISION):
                error = arb(form(row * L, identity(n))) * epsilon_up / alpha**2
                slack = (arb(slack) - error).lower().fmpq()
        yield at_least_zero(f"(C4)-(C6) input {i + 1}", slack)
    yield definite("(C7) rho lambda_min(L) >= lambda_max(L)", _ratios(rho, L))


def _constants(kappa: Any, rho: Any, plant: LinearPlant) -> tuple[Any, Any, Any]:
    """Returns enclosures of eps_up, eps and alpha (Theorems 2 and 3, Definition 4) with g_bar^2 = kappa rho."""
    g2, gamma = arb(kappa * rho), arb(number(plant.gamma))
    q_bar = _largest_eigenvalue(matrix(plant.process_noise.covariance)) + gamma
    p0, A = _largest_eigenvalue(matrix(plant.initial_noise.covariance)), matrix(plant.A)
    quantile = arb(number(plant.process_noise.energy))
    epsilon_up = (p0 * g2 + q_bar / arb(1 - kappa * rho)) * quantile
    norm = _largest_eigenvalue(A.transpose() * A).sqrt()
    epsilon = (g2.sqrt() + norm) ** 2 * epsilon_up
    return epsilon_up, epsilon, ((gamma.sqrt() + epsilon.sqrt()) / (1 - arb(kappa).sqrt())) ** 2


def _largest_eigenvalue(symmetric: Any) -> Any:
    """Returns an enclosure of the largest eigenvalue of a semidefinite matrix: a root of its polynomial."""
    whole, denominator = symmetric.numer_denom()
    largest = arb(0)
    for root, _ in whole.charpoly().complex_roots():
        largest = largest.max(root.real)
    return largest / arb(denominator)


def _is_near(stated: float, true: Any) -> bool:
    """Returns whether a stated constant is the true one, but for a rounding."""
    return bool(abs(arb(number(stated)) - true) <= arb(_STATED) * true)


def _ratios(rho: Any, L: Any) -> Any:
    """Returns rho (L x I) - (I x L), whose eigenvalues are rho l_i - l_j for all eigenvalues l of L, (n^2, n^2)."""
    n = L.nrows()
    entries = [
        (rho * L[i, k] if j == h else fmpq(0)) - (L[j, h] if i == k else fmpq(0))
        for i in range(n)
        for j in range(n)
        for k in range(n)
        for h in range(n)
    ]
    return fmpq_mat(n * n, n * n, entries)
