"""(G), (B) and (PB) of docs/shield_proof.md by the second engine: exponentials and roots as balls."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from flint import arb, arb_mat, ctx, fmpq

from ncs_gym import Ellipsoid, LinearPlant
from shields.certificate import Certificate
from shields.verification.condition import Condition
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
from tests.second_verifier.polytope import Inside, extents


def between_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks what a certificate claims of times between samples, without the code of the first engine."""
    grid, points = plant.grid_rows, plant.between_samples
    if points is None and certificate.between_samples is None:
        return
    is_claimed = points == certificate.between_samples and grid is not None
    yield is_so("between samples: the certificate has the plant's grid", is_claimed)
    if grid is None or plant.continuous_model is None or points is None or not is_claimed:
        return
    held = any(number(entry) != 0 for entry in plant.step_offset)
    yield is_so("between samples: no constant disturbance holds the operating point", not held)
    (k, n), m, S = plant.box.shape, plant.m, certificate.safe_set
    kept = (grid.state.shape, grid.input.shape, grid.remainder.shape) == ((points, k, n), (points, k, m), (k,))
    if kept:
        first = np.concatenate([grid.state[0] - plant.box, grid.input[0]], axis=1)
        kept = bool(np.isfinite(grid.remainder).all()) and not np.count_nonzero(first)
    yield is_so("between samples: the grid has all its points and begins with the safe box", kept)
    ends = [[number(end) if np.isfinite(end) else None for end in pair] for pair in plant.box_ends.T]
    widths = extents(matrix(plant.box).tolist(), ends, k)
    yield is_so("between samples: the box bounds every state", widths is not None)
    if not kept or widths is None:
        return
    with ctx.workprec(PRECISION):
        for j, least in enumerate(_remainders(plant, widths + [number(limit) for limit in plant.largest_input])):
            name = f"(G) what is between grid points is at most eta of row {j + 1}"
            yield ball_at_least_zero(name, arb(number(grid.remainder[j])) - least)
        fits = isinstance(S, Ellipsoid) or len(S.multipliers) == len(S.rows) + m + k * points + len(plant.mixed_rows)
        if fits:
            yield from _gain_conditions(certificate, plant)


def _remainders(plant: LinearPlant, sizes: list[Any]) -> list[Any]:
    """Returns balls around the least eta that is proved for each row of the box, given the largest |x_i| and |u_i|."""
    grid, model, points = plant.grid_rows, plant.continuous_model, plant.between_samples
    assert grid is not None
    assert model is not None
    assert points is not None
    (k, _), m, dt = plant.box.shape, plant.m, number(plant.dt)
    size = len(sizes)
    G = matrix(np.vstack([model, np.zeros((m, size))]))
    box = matrix(np.hstack([plant.box, np.zeros((k, m))]))
    rates = [
        G[i, i] + sum((abs(G[i, j]) * sizes[j] for j in range(size) if j != i), fmpq(0)) / sizes[i] for i in range(size)
    ]
    growth = (arb(max(*rates, fmpq(0))) * arb(dt / points)).exp()
    errors, bends = [arb(0)] * k, [arb(0)] * k
    for i in range(points + 1):
        true = arb_mat(box) * arb_mat(G * (dt * i / points)).exp()
        if i == points:  # the sampled plant itself
            rows = matrix(plant.box) * matrix(np.hstack([plant.A, plant.B]))
        else:
            rows = matrix(np.hstack([grid.state[i], grid.input[i]]))
        bend = true * arb_mat(G * G)
        for row in range(k):
            off = [abs(true[row, j] - arb(rows[row, j])) * arb(sizes[j]) for j in range(size)]
            errors[row] = errors[row].max(sum(off, arb(0)))
            if i < points:
                turn = [abs(bend[row, j]) * arb(sizes[j]) for j in range(size)]
                bends[row] = bends[row].max(sum(turn, arb(0)))
    square = arb(dt * dt / (8 * points * points))
    return [error + square * growth * bend for error, bend in zip(errors, bends, strict=True)]


def _gain_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (B) of an ellipsoid, (PB) of a polytope."""
    grid, S, k = plant.grid_rows, certificate.safe_set, len(plant.box)
    assert grid is not None
    K, D = matrix(certificate.K), matrix(certificate.D)
    errors = [mapped(K, matrix(proof.Sigma)) for proof in certificate.proofs]
    rest = matrix(np.concatenate([certificate.resting_state, certificate.resting_input])).transpose()
    half = [number(each) for each in plant.input_half]
    inside = None if isinstance(S, Ellipsoid) else Inside.of(S, k)
    for i, (state, pushed) in enumerate(zip(grid.state, grid.input, strict=True)):
        for j in range(k):
            push = matrix(pushed[j])
            image = matrix(state[j]) + push * K
            taken = arb(number(grid.remainder[j]) + FLOAT32 * reach_of(push, half))
            taken += arb(form(matrix(plant.box[j]), D)).sqrt()
            taken += arb(max(form(push, error) for error in errors)).sqrt()
            where = f"tau_{i} of row {j + 1}"
            if isinstance(S, Ellipsoid):
                name, reached = f"(B) |c x| + rho <= 1 - eta on S at {where}", form(image, matrix(S.shape_matrix))
                yield ball_at_least_zero(name, 1 - taken - arb(reached).sqrt())
            elif inside is not None:
                at_rest = (matrix(np.concatenate([state[j], pushed[j]])) * rest)[0, 0]
                ends = [number(end[j]) - at_rest if np.isfinite(end[j]) else None for end in plant.box_ends]
                which = len(S.rows) + plant.m + i * k + j
                left = inside.distance(image.tolist()[0], which, *ends) - taken
                yield ball_at_least_zero(f"(PB) |c x| + rho <= 1 - eta on S at {where}", left)
