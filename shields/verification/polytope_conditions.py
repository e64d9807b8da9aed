"""The conditions of a polytope (docs/shield_proof.md, "Polytopes"), evaluated in rational arithmetic."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.polytope import Polytope
from shields.verification.conditions import ACTION_ROUNDING, Condition, flag, scalar_condition
from shields.verification.rational_matrix import (
    Matrix,
    add,
    congruence,
    multiply,
    quadratic,
    rational,
    transpose,
    weighted_size,
)

# Binary digits behind the point of an upper bound of a root.
_ROOT_DIGITS = 128


def polytope_conditions(polytope: Polytope, certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (P) and (PU): the polytope is in the box, invariant under u = K x_hat, which respects the input limits.

    With r = g (A+BK) - lambda G the next |g x+| is at most sum |lambda| + sum_k |r_k| w_k + s + d, where s bounds the
    root of g BK Sigma (BK)' g' for all error sets, and d that of g D g' and what rounding the action does.
    """
    rows, box = polytope.rows, plant.box_rows
    images = len(rows) + plant.m + len(box) * (plant.between_samples or 0)
    fits = polytope.multipliers.shape == (images, len(rows))
    yield flag("polytope: shapes", fits)
    if not fits:
        return
    leads = len(rows) >= len(box) and bool((rows[: len(box)] == box).all())
    yield flag("polytope: its first rows are those of the safe box", leads)
    widths = half_widths(rational(box))
    yield flag("polytope: the box bounds every state", widths is not None)
    if not leads or widths is None:
        return
    G, B, K = rational(rows), rational(plant.B), rational(certificate.K)
    next_rows = multiply(G, add(rational(plant.A), multiply(B, K)))
    pushed, D = multiply(G, B), rational(certificate.D)
    errors = [congruence(K, rational(proof.Sigma)) for proof in certificate.proofs]
    limits = [Fraction(float(limit)) for limit in plant.u_max]
    multipliers = polytope.multipliers
    for i, image in enumerate(next_rows):
        s = root_above(max(quadratic([pushed[i]], error) for error in errors))
        d = root_above(quadratic([G[i]], D))
        d += ACTION_ROUNDING * weighted_size(pushed[i], limits)
        left = 1 - reach(image, multipliers[i], G, widths) - s - d
        yield scalar_condition(f"(P) sum |lambda| + |r| w + s + d <= 1 of row {i + 1}", left)
    for i, (gain, limit) in enumerate(zip(K, limits, strict=True)):
        rho = limit * root_above(max(error[i][i] for error in errors) / limit**2)
        allowed = limit * (1 - ACTION_ROUNDING)
        left = allowed - reach(gain, multipliers[len(rows) + i], G, widths) - rho
        yield scalar_condition(f"(PU) input {i + 1} stays within u_max (1 - 2^-24) on the polytope", left)


def reach(image: list[Fraction], multipliers: np.ndarray, G: Matrix, widths: list[Fraction]) -> Fraction:
    """Returns sum |lambda| + sum_k |r_k| w_k, which bounds |image x| on the polytope."""
    rest, total = list(image), Fraction(0)
    for index in np.flatnonzero(multipliers):
        multiplier = Fraction(float(multipliers[index]))
        total += abs(multiplier)
        rest = [left - multiplier * entry for left, entry in zip(rest, G[index], strict=True)]
    return total + weighted_size(rest, widths)


def half_widths(box: Matrix) -> list[Fraction] | None:
    """Returns bounds of |x_k| over |c_j x| <= 1; None if there are none.

    x = (C'C)^-1 C' y for |y_j| <= 1, so that is a sum of absolute values of a row of this matrix.
    """
    turned, n = transpose(box), len(box[0])
    rows = [gram + side for gram, side in zip(multiply(turned, box), turned, strict=True)]
    for i in range(n):
        if not (pivot := rows[i][i]):  # of a semidefinite matrix, which is singular then
            return None
        rows[i] = [entry / pivot for entry in rows[i]]
        for other in range(n):
            if other != i and (factor := rows[other][i]):
                rows[other] = [entry - factor * own for entry, own in zip(rows[other], rows[i], strict=True)]
    return [sum(map(abs, row[n:]), Fraction(0)) for row in rows]


def root_above(square: Fraction) -> Fraction:
    """Returns an upper bound of the root of a number, at most 2^-128 above it; of one below zero, which none is, 0."""
    scaled = math.ceil(max(square, Fraction(0)) * 4**_ROOT_DIGITS)
    root = math.isqrt(scaled)
    return Fraction(root + (root * root < scaled), 2**_ROOT_DIGITS)
