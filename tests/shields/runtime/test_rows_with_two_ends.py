"""Rows whose ends differ; certificates have none yet."""

import cvxpy as cp
import numpy as np
import pytest

from ncs_gym import Ellipsoid
from shields.runtime.set_test import SetTest
from tests.plants import random_plant

PLANTS = {m: random_plant(4, 3, m, gamma=1e-4) for m in (1, 2, 3)}


def uneven(plant, rng):
    """A test of the states between uneven ends, some of them far out, and its rows and ends."""
    rows = np.concatenate([np.eye(plant.n), rng.standard_normal((5, plant.n))])
    low, high = -rng.uniform(0.2, 3.0, len(rows)), rng.uniform(0.2, 3.0, len(rows))
    low[plant.n], high[plant.n + 1] = -100.0, 100.0  # open limits
    return SetTest(plant, np.empty((0, plant.n)), rows, low, high), rows, low, high


def reached(plant, rows, estimate, shape, u):
    """The least and largest row x+ over all errors and disturbances, by their extreme points."""
    error, pushes, center = Ellipsoid(shape), plant.disturbance, plant.A @ estimate + plant.B @ u
    far = [row @ plant.A @ error.extreme_point(row @ plant.A) + row @ pushes.extreme_point(row) for row in rows]
    return rows @ center - far, rows @ center + far


@pytest.mark.parametrize("m", PLANTS)
def test_inputs_that_pass_keep_every_extreme_point_between_both_ends(m):
    plant, rng, passed = PLANTS[m], np.random.default_rng(m), 0
    for _ in range(60):
        test, rows, low, high = uneven(plant, rng)
        shape, x_hat, u = 1e-3 * np.eye(plant.n), 0.2 * rng.standard_normal(plant.n), 0.3 * rng.uniform(-1, 1, m)
        errors = test.predicted(shape[None], np.empty((0, plant.n, plant.n)))
        least, most = reached(plant, rows, x_hat, shape, u)
        expected = min((least - low).min(), (high - most).min())
        test_margin, margin = (each.item() for each in test.reachable(x_hat[:, None], errors).margins(u[:, None]))
        assert test_margin == margin == pytest.approx(expected, abs=1e-9)
        assert test_margin <= expected + 1e-15
        if errors.radius.item() > 1e-3:
            assert test.margins_alone(x_hat, errors.single(), u) == pytest.approx((margin, margin), abs=1e-12)
        own = np.array([Ellipsoid(shape).support(row) for row in rows])
        inside = min((rows @ x_hat - own - low).min(), (high - rows @ x_hat - own).min())
        assert test.knows_inside(x_hat, errors.single(), 0.0) == (inside > 0.0)
        corners = plant.u_max * (2.0 * np.array(list(np.ndindex(*[2] * m))) - 1.0)
        worst = [reached(plant, rows, x_hat, shape, corner) for corner in corners]
        smallest = min(min((least - low).min(), (high - most).min()) for least, most in worst)
        assert test.reachable(x_hat[:, None], errors).smallest_test_margin().item() == pytest.approx(smallest, abs=1e-9)
        passed += expected > 0.0
    assert 5 < passed < 55


@pytest.mark.cases(2)
@pytest.mark.parametrize("m", PLANTS)
def test_closest_inputs_between_uneven_ends_are_those_of_a_solver(m):
    plant, rng, found, infeasible = PLANTS[m], np.random.default_rng(m), 0, 0
    for _ in range(60):
        test, rows, low, high = uneven(plant, rng)
        shape, x_hat = 1e-3 * np.eye(plant.n), 1.2 * rng.standard_normal(plant.n)
        wanted = rng.uniform(-1.0, 1.0, m) * plant.u_max
        errors = test.predicted(shape[None], np.empty((0, plant.n, plant.n)))
        with np.errstate(all="ignore"):
            closest = test.reachable(x_hat[:, None], errors).closest(wanted[:, None], 0.0)[:, 0]
        least, most = reached(plant, rows, x_hat, shape, np.zeros(m))
        u = cp.Variable(m)
        effect = rows @ plant.B
        limits = [cp.abs(u) <= plant.u_max, most + effect @ u <= high]
        limits += [least + effect @ u >= low]
        problem = cp.Problem(cp.Minimize(cp.sum_squares(u - wanted)), limits)
        problem.solve(solver=cp.CLARABEL)
        if problem.status == cp.OPTIMAL:
            np.testing.assert_allclose(closest, u.value, atol=1e-5)
            found += np.abs(closest - wanted).max() > 1e-3
            if m == 1 and errors.radius.item() > 1e-3:
                alone = test.closest_alone(x_hat, errors.single(), wanted.item(), 0.0)
                assert alone == pytest.approx(closest.item(), abs=1e-9)
        elif problem.status == cp.INFEASIBLE:
            infeasible += 1
            assert np.isnan(closest).all()
    assert found > 5
    assert infeasible > 0 or m == plant.n  # which can be moved anywhere
