"""Extreme values of rows in a polytope, against linear programs of their own."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import linprog

from shields.synthesis import faces as synthesis_faces
from shields.synthesis.faces import Extremes, Faces, multipliers_of


def faces_of(rng, r, n, *, symmetric=False, some_open=True):
    rows = rng.standard_normal((r, n)) * 10.0 ** rng.uniform(-2.0, 2.0, (1, n))
    low, high = -rng.uniform(0.1, 2.0, r), rng.uniform(0.1, 2.0, r)
    if symmetric:
        low = -high
    elif some_open:
        low[::3], high[1::3] = -math.inf, math.inf
    return Faces(rows, low, high)


def largest(faces, row):
    above, below = np.isfinite(faces.high), np.isfinite(faces.low)
    A = np.concatenate([faces.rows[above], -faces.rows[below]])
    found = linprog(-row, A, np.concatenate([faces.high[above], -faces.low[below]]), bounds=(None, None))
    return -found.fun if found.status == 0 else math.inf


def assert_extreme(within, row):
    faces = within.faces
    least, most = within.of(row)
    assert most == pytest.approx(largest(faces, row), rel=1e-6)
    assert least == pytest.approx(-largest(faces, -row), rel=1e-6)
    for value, multipliers, sign in zip((least, most), multipliers_of(faces, row), (-1.0, 1.0), strict=True):
        if math.isfinite(value):
            np.testing.assert_allclose(multipliers @ faces.rows, row, rtol=1e-6, atol=1e-8)
            used, prices = multipliers != 0.0, sign * multipliers
            ends = np.where(prices > 0.0, faces.high, -faces.low)
            assert sign * value == pytest.approx(np.abs(prices[used]) @ ends[used], rel=1e-6)
        else:
            np.testing.assert_array_equal(multipliers, 0.0)


@pytest.mark.cases(3)
@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_values_and_multipliers_are_those_of_a_linear_program_of_its_own(seed, symmetric):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    within = Extremes(faces_of(rng, 3 * n, n, symmetric=symmetric))
    for _ in range(4):
        row = rng.standard_normal(n) * np.abs(within.faces.rows).max(axis=0)
        assert_extreme(within, row)
        number = int(rng.integers(len(within.faces.rows)))
        low, high = float(within.faces.low[number]), float(within.faces.high[number])
        within.set_ends(number, -math.inf, math.inf)
        assert_extreme(within, row)
        within.set_ends(number, low, high)
        within.add(faces_of(rng, 2, n, symmetric=symmetric, some_open=False))
        assert_extreme(within, row)


def test_what_has_no_end_is_infinite_and_later_faces_give_it_one():
    within = Extremes(Faces(np.array([[1.0, 0.0]]), np.array([-1.0]), np.array([2.0])))
    assert within.of(np.array([0.0, 1.0])) == (-math.inf, math.inf)
    assert within.of(np.array([3.0, 0.0])) == pytest.approx((-3.0, 6.0))
    within.add(Faces(np.array([[1.0, 1.0]]), np.array([-math.inf]), np.array([1.0])))
    assert within.of(np.array([0.0, 1.0])) == (-math.inf, pytest.approx(2.0))


@pytest.mark.parametrize("number", [math.nan, math.inf, 1e300])
def test_numbers_out_of_reach_are_refused(number):
    rows = np.array([[number, 1.0]])
    with pytest.raises(ArithmeticError, match="numbers from 1e\\+15 on"):
        Extremes(Faces(rows, -np.ones(1), np.ones(1)))
    within = Extremes(Faces(np.eye(2), -np.ones(2), np.ones(2)))
    with pytest.raises(ArithmeticError, match="numbers from 1e\\+15 on"):
        within.of(rows[0])


def test_presolve_that_fails_is_repeated_without_one(monkeypatch):
    polytope, row = faces_of(np.random.default_rng(0), 6, 2, symmetric=True), np.array([1.0, 0.5])
    proved = multipliers_of(polytope, row)

    def solved(*args, options, **others):
        found = linprog(*args, options=options, **others)
        found.status = 4 if options["presolve"] else found.status
        return found

    monkeypatch.setattr(synthesis_faces, "linprog", solved)
    np.testing.assert_allclose(multipliers_of(polytope, row), proved, rtol=1e-9, atol=1e-12)
