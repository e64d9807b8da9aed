"""(P) and (PU) of docs/shield_proof.md by the second engine: rational matrices, roots as balls."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from flint import arb, ctx, fmpq, fmpq_mat

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.polytope import Polytope
from shields.verification.conditions import Condition
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
    """Checks (P) and (PU) without the code of the first engine; what cannot be stated is left out."""
    r, (k, n) = len(polytope.rows), plant.box_rows.shape
    images = r + plant.m + k * (plant.between_samples or 0)
    fits = polytope.multipliers.shape == (images, r)
    yield is_so("polytope: shapes", fits)
    if not fits:
        return
    leads = r >= k and all(a == b for a, b in zip(polytope.rows[:k].ravel(), plant.box_rows.ravel(), strict=True))
    yield is_so("polytope: its first rows are those of the safe box", leads)
    widths = box_extents(matrix(plant.box_rows))
    yield is_so("polytope: the box bounds every state", widths is not None)
    if not leads or widths is None:
        return
    G, B, K = matrix(polytope.rows), matrix(plant.B), matrix(certificate.K)
    D = matrix(certificate.D)
    closed = matrix(plant.A) + B * K
    Lambda = matrix(polytope.multipliers[: r + plant.m])
    rest = fmpq_mat((G * closed).tolist() + K.tolist()) - Lambda * G
    bounds = [
        sum((abs(Lambda[i, j]) for j in np.flatnonzero(polytope.multipliers[i]).tolist()), fmpq(0))
        + sum((abs(rest[i, j]) * widths[j] for j in range(n)), fmpq(0))
        for i in range(r + plant.m)
    ]
    u_max = [number(limit) for limit in plant.u_max]
    errors = [matrix(proof.Sigma) for proof in certificate.proofs]
    images, gains = [mapped(B * K, Sigma) for Sigma in errors], [mapped(K, Sigma) for Sigma in errors]
    with ctx.workprec(PRECISION):
        for i in range(r):
            row = fmpq_mat([G.tolist()[i]])
            largest = max(form(row, image) for image in images)
            rounding = reach_of(row * B, u_max) * FLOAT32
            left = arb(1 - bounds[i] - rounding) - arb(largest).sqrt() - arb(form(row, D)).sqrt()
            yield ball_at_least_zero(f"(P) sum |lambda| + |r| w + s + d <= 1 of row {i + 1}", left)
        for i in range(plant.m):
            largest = max(gain[i, i] for gain in gains)
            left = arb(u_max[i] * (1 - FLOAT32) - bounds[r + i]) - arb(largest).sqrt()
            yield ball_at_least_zero(f"(PU) input {i + 1} stays within u_max (1 - 2^-24) on the polytope", left)


def box_extents(box: Any) -> list[Any] | None:
    """Returns bounds of |x_i| in the box; None if it does not bound all."""
    if box.rank() < box.ncols():
        return None
    # x = (C'C)^-1 C' (C x), and |C x| <= 1 entry by entry.
    inverse = (box.transpose() * box).inv() * box.transpose()
    return [sum((abs(inverse[i, j]) for j in range(box.nrows())), fmpq(0)) for i in range(box.ncols())]
