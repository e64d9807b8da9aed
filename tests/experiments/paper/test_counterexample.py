from fractions import Fraction
from functools import cache

import numpy as np
import pytest

from experiments.paper.counterexample import Ball, Box, stays_inside, worst_step
from experiments.paper.paper_example import PaperExample

CASE = PaperExample()
BOX = Box(CASE.disturbance_half_widths)


@cache
def worst(disturbances):
    return worst_step(CASE.closed_loop, CASE.M, disturbances, Ball(CASE.epsilon))


def exact(vector):
    return [Fraction(float(v)) for v in vector]


def test_counterexample_is_one_in_exact_arithmetic_with_a_disturbance_of_the_printed_box():
    step = worst(BOX)
    x, d, e = exact(step.state), exact(step.disturbance), exact(step.error)
    M = [exact(row) for row in CASE.M]
    closed = [exact(row) for row in CASE.closed_loop]

    def level(v):
        return sum(v[i] * M[i][j] * v[j] for i in range(2) for j in range(2))

    end = [sum(closed[i][j] * x[j] for j in range(2)) + d[i] + e[i] for i in range(2)]
    assert level(x) <= 1
    assert abs(d[0]) <= Fraction(0.02)
    assert abs(d[1]) <= Fraction(0.01)
    assert sum(v * v for v in e) <= Fraction(CASE.epsilon)
    assert level(end) > 1
    assert step.confirmed


def test_step_with_a_point_outside_its_set_is_not_confirmed(monkeypatch):
    assert worst_step(CASE.closed_loop, CASE.M, BOX, Ball(CASE.epsilon), starts=5).confirmed
    monkeypatch.setattr(Box, "contains", lambda self, point: False)
    assert not worst_step(CASE.closed_loop, CASE.M, BOX, Ball(CASE.epsilon), starts=5).confirmed


@pytest.mark.cases(1)
@pytest.mark.parametrize("disturbances", [BOX, Ball(5e-4)])
def test_worst_step_beats_random_search(disturbances):
    found = worst(disturbances)
    rng = np.random.default_rng(1)
    root = np.linalg.inv(np.linalg.cholesky(CASE.M).T)
    best = 0.0
    for _ in range(20_000):
        x, e = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 2)))
        d = disturbances.extreme_point(rng.standard_normal(2))
        end = CASE.closed_loop @ root @ x + d + CASE.epsilon**0.5 * e
        best = max(best, end @ CASE.M @ end)
    assert best <= found.level
    assert best > 0.98 * found.level


def test_proof_of_invariance_stands_where_no_step_leaves_and_falls_where_one_does():
    reachable = Ball(CASE.epsilon, along=CASE.B[:, 0])
    assert stays_inside(CASE.closed_loop, CASE.M, Ball(5e-4), reachable)
    assert not stays_inside(CASE.closed_loop, CASE.M, Ball(5e-4), Ball(CASE.epsilon))
    assert not stays_inside(CASE.closed_loop, CASE.M, Ball(5e-4), Ball(4.0 * CASE.epsilon, along=CASE.B[:, 0]))


@pytest.mark.parametrize("each", [Ball(0.04), Ball(0.04, along=np.array([3.0, 4.0])), Box(np.array([0.1, 0.2]))])
def test_extreme_points_are_farthest_and_inside(each):
    rng = np.random.default_rng(0)
    for slope in rng.standard_normal((20, 2)):
        end = each.extreme_point(slope)
        assert each.contains((1.0 - 1e-12) * end)
        assert not each.contains((1.0 + 1e-9) * end)
        others = [each.extreme_point(other) for other in rng.standard_normal((50, 2))]
        assert max(other @ slope for other in others) <= end @ slope + 1e-12
