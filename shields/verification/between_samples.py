"""The box between sampling instants (docs/shield_proof.md, "Between the samples"), decided in rational arithmetic."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from math import ceil

import numpy as np

from ncs_gym import Ellipsoid, LinearPlant
from shields.certificate import Certificate
from shields.verification.condition import Condition, flag, scalar_condition
from shields.verification.polytope_conditions import ends_from, faces_of, reach_of_error, root_above, widths_of
from shields.verification.rational_matrix import (
    Matrix,
    add,
    multiply,
    quadratic,
    rational,
    transpose,
    weighted_size,
)

# A series ends where what is left of it is below 2^-100, next to what a row reaches; one that is longer is not summed.
_LEFT_BITS, _SMALLEST_LEFT, _MOST_TERMS = 200, 2**100, 1000
# What rounding makes of a term is below this power of 1/2, next to what a row reaches.
_BITS = 140


def between_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks the claim of a certificate about times between samples; nothing where neither it nor the plant has one.

    (G): between the points of the plant's grid nothing is larger than at them by more than eta, which also covers that
    the rows of the grid are rounded. (B), or (PB) of a polytope: with u = K x_hat, |c x| stays so far below 1 at every
    point of the grid.
    """
    rows, model, points = plant.grid_rows, plant.continuous_model, plant.between_samples
    if certificate.between_samples is None and points is None:
        return
    claimed = certificate.between_samples == points and rows is not None and model is not None
    yield flag("between samples: the certificate has the plant's grid", claimed)
    if rows is None or model is None or points is None or not claimed:
        return
    yield flag("between samples: no constant disturbance holds the operating point", not plant.step_offset.any())
    (k, n), m = plant.box.shape, plant.m
    fits = rows.state.shape == (points, k, n) and rows.input.shape == (points, k, m) and model.shape == (n, n + m)
    fits = fits and rows.remainder.shape == (k,) and bool(np.isfinite(rows.remainder).all())
    fits = fits and bool((rows.state[0] == plant.box).all()) and not rows.input[0].any()
    yield flag("between samples: the grid has all its points and begins with the safe box", fits)
    low, high = (ends_from(side, Fraction(0)) for side in plant.box_ends)
    widths = widths_of(rational(plant.box), low, high, k)
    yield flag("between samples: the box bounds every state", widths is not None)
    if not fits or widths is None:
        return
    sizes = widths + [Fraction(float(limit)) for limit in plant.largest_input]
    G, eta = rational(np.concatenate([model, np.zeros((m, n + m))])), rational(rows.remainder)[0]
    sampled = multiply(rational(plant.box), rational(np.concatenate([plant.A, plant.B], axis=1)))
    for j, box_row in enumerate(rational(plant.box)):
        grid = [*rational(np.concatenate([rows.state[:, j], rows.input[:, j]], axis=1)), sampled[j]]
        least = _remainder(box_row + [Fraction(0)] * m, grid, G, sizes, Fraction(plant.dt))
        left = Fraction(-1) if least is None else eta[j] - least
        yield scalar_condition(f"(G) what is between grid points is at most eta of row {j + 1}", left)
    yield from _closed_loop_conditions(certificate, plant)


def _closed_loop_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Checks (B) of an ellipsoid, (PB) of a polytope: with the fallback every point of the grid is inside.

    All is counted from the resting point, at which c x has a value of its own at every time.
    """
    rows, S, k = plant.grid_rows, certificate.safe_set, len(plant.box)
    assert rows is not None
    K, D, reach = rational(certificate.K), rational(certificate.D), reach_of_error(certificate, plant)
    x_c, u_c = rational(certificate.resting_state), rational(certificate.resting_input)
    faces = None if isinstance(S, Ellipsoid) else faces_of(S, k)
    for j, row in enumerate(rational(plant.box)):
        taken = Fraction(float(rows.remainder[j])) + root_above(quadratic([row], D))
        for i in range(len(rows.state)):
            moved, pushed = rational(rows.state[i, j]), rational(rows.input[i, j])
            image = add(moved, multiply(pushed, K))[0]
            if isinstance(S, Ellipsoid):  # within symmetric limits
                name, left = "(B)", 1 - root_above(quadratic([image], rational(S.shape_matrix)))
            else:
                assert faces is not None  # (P) holds
                at_rest = multiply(moved, transpose(x_c))[0][0] + multiply(pushed, transpose(u_c))[0][0]
                ends = ends_from(plant.box_ends[:, j], at_rest)
                name, left = "(PB)", faces.left_of(image, len(faces.rows) + plant.m + i * k + j, *ends)
            claim = f"{name} |c x| + rho <= 1 - eta on S at tau_{i} of row {j + 1}"
            yield scalar_condition(claim, left - taken - reach(pushed[0]))


def _remainder(row: list[Fraction], grid: Matrix, G: Matrix, sizes: list[Fraction], dt: Fraction) -> Fraction | None:
    """Returns the least eta that is proved for a row [c, 0]; None if a series is too long.

    That is the largest error of the plant's grid for [c, 0] exp(G tau_i), i = 0..N, and h^2/8 exp(h m) max_i
    |[c, 0] exp(G tau_i) G^2|, measured by what they can reach for |z_j| <= W_j; m is the logarithmic norm of G.
    """
    points = len(grid) - 1
    h, error, bend, square = dt / points, Fraction(0), Fraction(0), multiply(G, G)
    norm = max(weighted_size(line, sizes) / sizes[i] for i, line in enumerate(G))
    drift = max(weighted_size(line, sizes) / sizes[i] + line[i] - abs(line[i]) for i, line in enumerate(G))
    rising = max(Fraction(ceil(drift * 2**64), 2**64), Fraction(0))
    growth = _moved([Fraction(1)], [[rising]], [Fraction(1)], h, rising)
    if growth is None:
        return None
    for i, given in enumerate(grid):
        moved = _moved(row, G, sizes, i * h, norm)
        if moved is None:
            return None
        exact, tail = moved
        error = max(error, weighted_size([a - b for a, b in zip(exact, given, strict=True)], sizes) + tail)
        if i < points:
            bend = max(bend, weighted_size(multiply([exact], square)[0], sizes) + tail * norm**2)
    return error + h * h / 8 * (growth[0][0] + growth[1]) * bend


def _moved(
    row: list[Fraction], G: Matrix, sizes: list[Fraction], time: Fraction, norm: Fraction
) -> tuple[list[Fraction], Fraction] | None:
    """Returns row exp(G t) by its series, and a bound of what it is off by; None if the series is too long.

    After the term of power p, left is at most |row| (t |G|)^(p+1) / (p+1)! / (1 - t |G| / (p+2)), with norm = |G|.
    Entry j of a term is a whole number of 2^-b / 2^(e_j), e_j least with W_j <= 2^(e_j), so that numbers stay short:
    rounding adds at most N 2^-b to each of p + 1 terms, and grows in later ones by at most exp(t |G|). |row| is
    sum |row_j| W_j; the denominators of G are powers of two.
    """
    reach, size = time * norm, weighted_size(row, sizes)
    if 2 * reach > _MOST_TERMS or size == 0:
        return None if size else (row, size)
    growth = 2 * ceil(reach)  # exp(reach) <= 2^growth
    scales = [size_j.numerator.bit_length() - size_j.denominator.bit_length() + 1 for size_j in sizes]
    b = (
        _BITS + growth + size.denominator.bit_length() - size.numerator.bit_length() + 1
    )  # 2^-b <= |row| 2^-_BITS / 2^growth
    scaled = [
        [entry * Fraction(2) ** (e - scales[i]) for entry, e in zip(line, scales, strict=True)]
        for i, line in enumerate(G)
    ]
    shift = max(entry.denominator.bit_length() - 1 for line in scaled for entry in line)
    columns = [*zip(*([int(entry * 2**shift) for entry in line] for line in scaled), strict=True)]
    term = [int(entry * Fraction(2) ** (e + b)) for entry, e in zip(row, scales, strict=True)]
    total, left = term, 2**_LEFT_BITS
    up, over = ceil(reach * 2**_LEFT_BITS), time.denominator << shift
    for power in range(1, _MOST_TERMS):
        left = -(-left * up // (power << _LEFT_BITS))
        pushed = [sum(a * g for a, g in zip(term, column, strict=True)) for column in columns]
        term = [each * time.numerator // (over * power) for each in pushed]
        total = [a + c for a, c in zip(total, term, strict=True)]
        if 2 * reach <= power + 2 and left <= _SMALLEST_LEFT:
            exact = [Fraction(entry) / Fraction(2) ** (e + b) for entry, e in zip(total, scales, strict=True)]
            rounded = Fraction((power + 1) * len(row), 2**_BITS)
            return exact, size * (Fraction(left, 2**_LEFT_BITS) * 2 * reach / (power + 1) + rounded)
    return None
