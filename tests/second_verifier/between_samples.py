"""(G) of docs/shield_proof.md by another route: what limits at all times of a step ask, with exponentials as balls."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from flint import arb, arb_mat, ctx, fmpq

from ncs_gym import LinearPlant
from shields.verification.rational_matrix import Condition
from tests.second_verifier.exact import PRECISION, ball_at_least_zero, form, is_so, matrix, number


def row_conditions(plant: LinearPlant) -> Iterator[Condition]:
    """Checks that limits at samples and within a step imply those at all times, row by row of the box."""
    (k, n), m, points, q = plant.box.shape, plant.m, plant.between_samples or 1, len(plant.mixed_rows)
    fits = plant.step_rows.shape == (q + k * (points - 1), n + m) and plant.kept_ends.shape == (2, k)
    fits = fits and plant.step_ends[:, q:].tolist() == np.tile(plant.kept_ends, points - 1).tolist()
    fits = fits and plant.step_rows[:q].tolist() == plant.mixed_rows.tolist()
    fits = fits and plant.step_ends[:, :q].tolist() == plant.mixed_ends.tolist()
    yield is_so("rows at all other times, with the ends of those at samples", fits)
    if not fits:
        return
    both = np.isfinite(plant.box_ends).all(axis=0)
    C, sizes = matrix(plant.box[both]), [number(each) for each in np.abs(plant.box_ends[:, both]).max(axis=0)]
    inverse = (C.transpose() * C).inv() * C.transpose()
    widths = [sum((abs(inverse[i, j]) * size for j, size in enumerate(sizes)), fmpq(0)) for i in range(n)]
    widths = [width if own is None else min(width, own) for width, own in zip(widths, _own_widths(plant), strict=True)]
    with ctx.workprec(PRECISION):
        needed = _remainders(plant, widths + [number(limit) for limit in plant.largest_input])
        for j, least in enumerate(needed):
            rho = arb(form(matrix(plant.box[j]), matrix(plant.disturbance.shape_matrix))).sqrt()
            for side, (given, kept) in enumerate(zip(plant.box_ends[:, j], plant.kept_ends[:, j], strict=True)):
                if np.isfinite(given):
                    taken = (1 - 2 * side) * (number(kept) - number(given))
                    name = f"(G) end {side} of row {j + 1} is closer by what is between grid points, and by rho"
                    yield ball_at_least_zero(name, arb(taken) - least - rho)
                else:
                    yield is_so(f"end {side} of row {j + 1} is open", kept == given)


def _own_widths(plant: LinearPlant) -> list[Any]:
    """Returns the largest |x_j| that rows of this state alone allow; None where an end of it is open."""
    widths: list[Any] = []
    for j in range(plant.n):
        alone = [
            (row[j], ends) for row, ends in zip(plant.box, plant.box_ends.T, strict=True) if not np.delete(row, j).any()
        ]
        each = [
            (number(end) / number(c), (end < 0) == (c > 0)) for c, ends in alone for end in ends if np.isfinite(end)
        ]
        lows, highs = [value for value, is_low in each if is_low], [value for value, is_low in each if not is_low]
        widths.append(max(-max(lows), min(highs)) if lows and highs else None)
    return widths


def _remainders(plant: LinearPlant, sizes: list[Any]) -> list[Any]:
    """Returns balls around the least eta that is proved for each row of the box, given the largest |x_i| and |u_i|."""
    model, points, q = plant.model.continuous, plant.between_samples or 1, len(plant.mixed_rows)
    k, m, dt, size = len(plant.box), plant.m, number(plant.dt), len(sizes)
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
        elif i:
            rows = matrix(plant.step_rows[q + (i - 1) * k :][:k])
        else:
            rows = box
        bend = true * arb_mat(G * G)
        for row in range(k):
            off = [abs(true[row, j] - arb(rows[row, j])) * arb(sizes[j]) for j in range(size)]
            errors[row] = errors[row].max(sum(off, arb(0)))
            if i < points:
                turn = [abs(bend[row, j]) * arb(sizes[j]) for j in range(size)]
                bends[row] = bends[row].max(sum(turn, arb(0)))
    square = arb(dt * dt / (8 * points * points))
    return [error + square * growth * bend for error, bend in zip(errors, bends, strict=True)]
