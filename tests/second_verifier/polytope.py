"""(P), (PU) and (PM) of docs/shield_proof.md by the second engine: rational matrices, roots as balls."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from flint import arb, ctx, fmpq, fmpq_mat

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.polytope import Polytope
from shields.verification.rational_matrix import Condition
from tests.second_verifier.exact import (
    FLOAT32,
    PRECISION,
    ball_at_least_zero,
    form,
    is_so,
    mapped,
    matrix,
    number,
    reach_of,
)


def polytope_conditions(polytope: Polytope, certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (P), (PU) and (PM) without the code of the first engine; what cannot be stated is left out."""
    r, k = len(polytope.rows), len(plant.box)
    before = r + plant.m
    fits = polytope.multipliers.shape == (before + len(plant.step_rows), r)
    yield is_so("polytope: shapes", fits)
    if not fits:
        return
    leads = r >= k and all(a == b for a, b in zip(polytope.rows[:k].ravel(), plant.box.ravel(), strict=True))
    leads = leads and polytope.low[:k].tolist() == plant.kept_ends[0].tolist()
    leads = leads and polytope.high[:k].tolist() == plant.kept_ends[1].tolist()
    yield is_so("polytope: its first rows are those of the safe box", leads)
    if not leads:
        return
    inside = Inside.of(polytope, k)
    yield is_so("polytope: it bounds every state", inside is not None)
    if inside is None:
        return
    B, K, D = matrix(plant.B), matrix(certificate.K), matrix(certificate.D)
    images, gains = (inside.G * (matrix(plant.A) + B * K)).tolist(), K.tolist()
    errors = [matrix(proof.Sigma) for proof in certificate.proofs]
    half = [number(each) for each in plant.input_half]
    with ctx.workprec(PRECISION):
        for i, image in enumerate(images):
            row = fmpq_mat([inside.G.tolist()[i]])
            largest = max(form(row, mapped(B * K, Sigma)) for Sigma in errors)
            left = inside.distance(image, i, *inside.ends[i]) - arb(reach_of(row * B, half) * FLOAT32)
            left -= arb(largest).sqrt() + arb(form(row, D)).sqrt()
            yield ball_at_least_zero(f"(P) sum |lambda| + |r| w + s + d <= 1 of row {i + 1}", left)
        for i, gain in enumerate(gains):
            largest = max(mapped(K, Sigma)[i, i] for Sigma in errors)
            ends = [number(end[i]) - number(certificate.resting_input[i]) for end in plant.input_ends]
            left = inside.distance(gain, r + i, *ends) - arb(FLOAT32 * half[i]) - arb(largest).sqrt()
            yield ball_at_least_zero(f"(PU) input {i + 1} stays within u_max (1 - 2^-24) on the polytope", left)
        at_rest = [*certificate.resting_state, *certificate.resting_input]
        for i in range(len(plant.step_rows)):
            both = matrix(plant.step_rows[i]).tolist()[0]
            state, push = fmpq_mat([both[: plant.n]]), fmpq_mat([both[plant.n :]])
            value = sum((a * number(b) for a, b in zip(both, at_rest, strict=True)), fmpq(0))
            ends = [number(end[i]) - value if np.isfinite(end[i]) else None for end in plant.step_ends]
            left = inside.distance((state + push * K).tolist()[0], before + i, *ends)
            left -= arb(max(form(push, mapped(K, Sigma)) for Sigma in errors)).sqrt()
            left -= arb(FLOAT32 * reach_of(push, half))
            yield ball_at_least_zero(f"(PM) the limit of row {i + 1} within a step holds on the polytope", left)


class Inside:
    """What is known of x in a polytope, counted from its center.

    Attributes:
        G: Its rows.
        ends: Low and high end of each row; None for open ones.
        widths: Bounds of |x_i|.
    """

    @classmethod
    def of(cls, polytope: Polytope, box_rows: int) -> Inside | None:
        """Returns it, or None if some state is not bounded."""
        inside = cls()
        inside.G = matrix(polytope.rows)
        at_center = (inside.G * matrix(polytope.center).transpose()).tolist()
        inside.ends = [
            [number(end) - value if np.isfinite(end) else None for end in pair]
            for pair, (value,) in zip(zip(polytope.low, polytope.high, strict=True), at_center, strict=True)
        ]
        inside._upper, inside._lower = polytope.multipliers, polytope.lower_multipliers
        inside.widths = extents(inside.G.tolist(), inside.ends, box_rows)
        return None if inside.widths is None else inside

    def distance(self, image: list[Any], which: int, low: Any, high: Any) -> Any:
        """Returns a ball around how far image x stays from two ends, by the multipliers of this number."""
        found = []
        if high is not None:
            found.append(high - self._most(image, self._upper[which]))
        if low is not None:  # of the mirrored image the mirrored multipliers
            found.append(-low - self._most([-each for each in image], -self._lower[which]))
        return arb(min(found))

    def _most(self, image: list[Any], multipliers: np.ndarray) -> Any:
        used = [(j, number(multipliers[j])) for j in np.flatnonzero(multipliers).tolist()]
        used = [(j, value) for j, value in used if self.ends[j][int(value > 0)] is not None]
        over = fmpq_mat([image]) - sum(
            (value * fmpq_mat([self.G.tolist()[j]]) for j, value in used), fmpq_mat(1, len(image))
        )
        return sum((value * self.ends[j][int(value > 0)] for j, value in used), reach_of(over, self.widths))


def extents(rows: list[Any], ends: list[Any], first: int) -> list[Any] | None:
    """Returns bounds of |x_i| by the first rows that have two ends, or else by all; None if there are none."""
    for count in (first, len(rows)):
        some = zip(rows[:count], ends[:count], strict=True)
        kept = [[each / max(-pair[0], pair[1]) for each in row] for row, pair in some if None not in pair]
        if kept and (found := box_extents(fmpq_mat(kept))) is not None:
            return found
    return None


def box_extents(box: Any) -> list[Any] | None:
    """Returns bounds of |x_i| where |box x| <= 1; None if it does not bound all."""
    if box.rank() < box.ncols():
        return None
    # x = (C'C)^-1 C' (C x), and |C x| <= 1 entry by entry.
    inverse = (box.transpose() * box).inv() * box.transpose()
    return [sum((abs(inverse[i, j]) for j in range(box.nrows())), fmpq(0)) for i in range(box.ncols())]
