"""The conditions of a polytope (docs/shield_proof.md, "Polytopes"), evaluated in rational arithmetic."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.polytope import Polytope
from shields.verification.conditions import Condition, flag, scalar_condition
from shields.verification.rational_matrix import Matrix, add, congruence, multiply, quadratic, rational

# Rounding an action in [-1, 1] to float32 changes it by at most this.
_ACTION_ROUNDING = Fraction(1, 2**24)
# Binary digits behind the point of an upper bound of a root.
_ROOT_DIGITS = 128


def polytope_conditions(polytope: Polytope, certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (P) and (PU): the polytope is in the box, invariant under u = K x_hat, which respects the input limits.

    With r = g (A+BK) - lambda G the next |g x+| is at most sum |lambda| + sum_k |r_k| w_k + s + d, where s bounds the
    root of g BK Sigma (BK)' g' for all error sets, and d that of g D g' and what rounding the action does.
    """
    rows, box = polytope.rows, plant.box_rows
    fits = rows.shape[1] == plant.n and polytope.multipliers.shape == (len(rows) + plant.m, len(rows))
    yield flag("polytope: shapes", fits)
    if not fits:
        return
    leads = len(rows) >= len(box) and bool((rows[: len(box)] == box).all())
    yield flag("polytope: its first rows are those of the safe box", leads)
    widths = _half_widths(rational(box))
    yield flag("polytope: the box bounds every state", widths is not None)
    if not leads or widths is None:
        return
    G, B, K = rational(rows), rational(plant.B), rational(certificate.K)
    next_rows = multiply(G, add(rational(plant.A), multiply(B, K)))
    pushed, D = multiply(G, B), rational(certificate.disturbances()[0])
    errors = [congruence(K, rational(proof.Sigma)) for proof in certificate.proofs]
    limits = [Fraction(float(limit)) for limit in plant.u_max]
    multipliers = polytope.multipliers
    for i, image in enumerate(next_rows):
        s = _root_above(max(quadratic([pushed[i]], error) for error in errors))
        d = _root_above(quadratic([G[i]], D))
        d += _ACTION_ROUNDING * sum((abs(b) * limit for b, limit in zip(pushed[i], limits, strict=True)), Fraction(0))
        left = 1 - _reach(image, multipliers[i], G, widths) - s - d
        yield scalar_condition(f"(P) sum |lambda| + |r| w + s + d <= 1 of row {i + 1}", left)
    for i, (gain, limit) in enumerate(zip(K, limits, strict=True)):
        rho = limit * _root_above(max(error[i][i] for error in errors) / limit**2)
        allowed = limit * (1 - _ACTION_ROUNDING)
        left = allowed - _reach(gain, multipliers[len(rows) + i], G, widths) - rho
        yield scalar_condition(f"(PU) input {i + 1} stays within u_max (1 - 2^-24) on the polytope", left)


def _reach(image: list[Fraction], multipliers: np.ndarray, G: Matrix, widths: list[Fraction]) -> Fraction:
    """Returns sum |lambda| + sum_k |r_k| w_k, which bounds |image x| on the polytope."""
    rest, total = list(image), Fraction(0)
    for index in np.flatnonzero(multipliers):
        multiplier = Fraction(float(multipliers[index]))
        total += abs(multiplier)
        rest = [left - multiplier * entry for left, entry in zip(rest, G[index], strict=True)]
    return total + sum((abs(left) * width for left, width in zip(rest, widths, strict=True)), Fraction(0))


def _half_widths(box: Matrix) -> list[Fraction] | None:
    """Returns bounds of |x_k| over |c_j x| <= 1 from n independent rows; None if there are none.

    With x = C^-1 y for these rows C and |y_j| <= 1 that is a sum of absolute values of a row of the inverse.
    """
    n = len(box[0])
    # Rows are reduced one after the other; what is appended records of which they are made.
    reduced: list[tuple[int, list[Fraction]]] = []
    for row in box:
        rest = [*row, *(Fraction(int(k == len(reduced))) for k in range(n))]
        for pivot, other in reduced:
            factor = rest[pivot]
            rest = [entry - factor * known for entry, known in zip(rest, other, strict=True)] if factor else rest
        pivot = next((k for k in range(n) if rest[k]), None)
        if pivot is None:
            continue
        rest = [entry / rest[pivot] for entry in rest]
        reduced = [
            (k, [entry - known[pivot] * new for entry, new in zip(known, rest, strict=True)]) for k, known in reduced
        ]
        reduced.append((pivot, rest))
        if len(reduced) == n:
            inverse = {k: known[n:] for k, known in reduced}
            return [sum(map(abs, inverse[k]), Fraction(0)) for k in range(n)]
    return None


def _root_above(square: Fraction) -> Fraction:
    """Returns an upper bound of the root of a number, at most 2^-128 above it; of one below zero, which none is, 0."""
    scaled = math.ceil(max(square, Fraction(0)) * 4**_ROOT_DIGITS)
    root = math.isqrt(scaled)
    return Fraction(root + (root * root < scaled), 2**_ROOT_DIGITS)
