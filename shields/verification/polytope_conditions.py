"""The conditions of a polytope (docs/shield_proof.md, "Polytopes"), evaluated in rational arithmetic."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.polytope import Polytope
from shields.verification.rational_matrix import (
    ACTION_ROUNDING,
    Condition,
    Matrix,
    add,
    congruence,
    flag,
    multiply,
    quadratic,
    rational,
    scalar_condition,
    subtract,
    to_float,
    transpose,
    weighted_size,
)

# Binary digits behind the point of an upper bound of a root.
_ROOT_DIGITS = 128


def polytope_conditions(polytope: Polytope, certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (P), (PU) and (PM): the polytope is in the box, and the fallback keeps it and all limits of inputs.

    All is counted from the resting point, where the fallback is u = K x_hat. With r = g (A+BK) - lambda G the next g x+
    is at most sum_i max(lambda_i high_i, lambda_i low_i) + sum_k |r_k| w_k + s + d, where s bounds the root of g BK
    Sigma (BK)' g' for all error sets, and d that of g D g' and what rounding the action does; from below likewise.
    """
    rows, box = polytope.rows, plant.box
    fits = polytope.multipliers.shape == (len(rows) + plant.m + len(plant.step_rows), len(rows))
    yield flag("polytope: shapes", fits)
    if not fits:
        return
    leads = len(rows) >= len(box) and bool((rows[: len(box)] == box).all())
    ends = polytope.low[: len(box)], polytope.high[: len(box)]
    leads = leads and bool((np.stack(ends) == plant.kept_ends).all())
    yield flag("polytope: its first rows are those of the safe box", leads)
    if not leads:
        return
    faces = faces_of(polytope, len(box))
    yield flag("polytope: it bounds every state", faces is not None)
    if faces is None:
        return
    G, B, K, reach = faces.rows, rational(plant.B), rational(certificate.K), reach_of_error(certificate, plant)
    pushed, D = multiply(G, B), rational(certificate.D)
    for i, image in enumerate(multiply(G, add(rational(plant.A), multiply(B, K)))):
        taken = reach(pushed[i]) + root_above(quadratic([G[i]], D))
        left = faces.left_of(image, i, faces.low[i], faces.high[i]) - taken
        yield scalar_condition(f"(P) sum |lambda| + |r| w + s + d <= 1 of row {i + 1}", left)
    u_c, unit = rational(certificate.resting_input)[0], rational(np.eye(plant.m))
    for i, gain in enumerate(K):
        left = faces.left_of(gain, len(rows) + i, *ends_from(plant.input_ends[:, i], u_c[i])) - reach(unit[i])
        yield scalar_condition(f"(PU) input {i + 1} stays within u_max (1 - 2^-24) on the polytope", left)
    # (PM): f x + g u = (f + g K) x - g K e around what it is at rest.
    rest = rational(np.concatenate([certificate.resting_state, certificate.resting_input]))
    for j, row in enumerate(plant.step_rows):
        mixed = rational(row)
        image = add([mixed[0][: plant.n]], multiply([mixed[0][plant.n :]], K))[0]
        ends = ends_from(plant.step_ends[:, j], multiply(mixed, transpose(rest))[0][0])
        left = faces.left_of(image, len(rows) + plant.m + j, *ends) - reach(mixed[0][plant.n :])
        yield scalar_condition(f"(PM) the limit of row {j + 1} within a step holds on the polytope", left)


def reach_of_error(certificate: Certificate, plant: LinearPlant) -> Callable[[list[Fraction]], Fraction]:
    """Returns what bounds a row of inputs, over all errors of the estimate in the fallback and roundings of actions."""
    K, half = rational(certificate.K), [Fraction(float(each)) for each in plant.input_half]
    errors = [congruence(K, rational(proof.Sigma)) for proof in certificate.proofs]

    def reach(row: list[Fraction]) -> Fraction:
        return root_above(max(quadratic([row], error) for error in errors)) + ACTION_ROUNDING * weighted_size(row, half)

    return reach


def ends_from(ends: np.ndarray, at: Fraction) -> list[Fraction | None]:
    """Returns two ends, counted from a number; None for one that is open."""
    return [Fraction(float(end)) - at if np.isfinite(end) else None for end in ends]


class Faces(NamedTuple):
    """A polytope around its center, in rational numbers.

    Attributes:
        rows: G.
        low, high: Ends of the rows from the center; None where there is none.
        multipliers, lower_multipliers: Those of the polytope.
        widths: w, bounds of |x_k|.
    """

    rows: Matrix
    low: list[Fraction | None]
    high: list[Fraction | None]
    multipliers: np.ndarray
    lower_multipliers: np.ndarray
    widths: list[Fraction]

    def left_of(self, image: list[Fraction], number: int, low: Fraction | None, high: Fraction | None) -> Fraction:
        """Returns the least distance of image x from its ends in the polytope that multipliers prove."""
        distances = []
        if high is not None:
            distances.append(high - self._reach(image, self.multipliers[number], self.high, self.low))
        if low is not None:
            reached = self._reach([-entry for entry in image], -self.lower_multipliers[number], self.high, self.low)
            distances.append(-low - reached)
        return min(distances)

    def _reach(
        self, image: list[Fraction], multipliers: np.ndarray, above: list[Fraction | None], below: list[Fraction | None]
    ) -> Fraction:
        """Returns sum_i max(lambda_i high_i, lambda_i low_i) + sum_k |r_k| w_k, which bounds image x from above."""
        chosen, total = dict[int, Fraction](), Fraction(0)
        for index in np.flatnonzero(multipliers).tolist():
            multiplier = Fraction(float(multipliers[index]))
            end = above[index] if multiplier > 0 else below[index]
            if end is not None:  # without the multiplier of a row that does not bound it more is left
                chosen[index], total = multiplier, total + multiplier * end
        made = multiply([list(chosen.values())], [self.rows[index] for index in chosen]) if chosen else []
        return total + weighted_size(subtract([image], made)[0] if made else image, self.widths)


def faces_of(polytope: Polytope, box_rows: int) -> Faces | None:
    """Returns a polytope around its center in rational numbers; None if its rows do not bound every state."""
    rows, center = rational(polytope.rows), rational(polytope.center)[0]
    reached = [sum((g * c for g, c in zip(row, center, strict=True)), Fraction(0)) for row in rows]
    pairs = zip(np.stack([polytope.low, polytope.high]).T, reached, strict=True)
    low, high = map(list, zip(*(ends_from(*pair) for pair in pairs), strict=True))
    widths = widths_of(rows, low, high, box_rows)
    if widths is None:
        return None
    return Faces(rows, low, high, polytope.multipliers, polytope.lower_multipliers, widths)


def widths_of(
    rows: Matrix, low: list[Fraction | None], high: list[Fraction | None], first: int
) -> list[Fraction] | None:
    """Returns bounds of |x_k| over low <= g_j x <= high; None if there are none.

    They follow from rows with two ends: from the first ones, or else from n that a factorization in floats picks.
    """
    ends = zip(rows, low, high, strict=True)
    bounded = [
        (j, [entry / max(-lo, hi) for entry in row])
        for j, (row, lo, hi) in enumerate(ends)
        if lo is not None and hi is not None
    ]
    leading, both = [row for j, row in bounded if j < first], [row for _, row in bounded]
    widths = half_widths(leading) if leading else None
    if widths is not None or len(both) < len(rows[0]):
        return widths
    columns = to_float(both).T
    picked = qr(columns / np.abs(columns).max(axis=1, keepdims=True).clip(1e-300), mode="r", pivoting=True)[-1]
    return half_widths([both[j] for j in picked[: len(columns)]])


def half_widths(box: Matrix) -> list[Fraction] | None:
    """Returns bounds of |x_k| over |c_j x| <= 1 from x = (C'C)^-1 C' y, |y_j| <= 1; None if there are none."""
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
