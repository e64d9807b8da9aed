from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from ncs_gym import Ellipsoid, truck_trailer
from shields import SafetyFilter, synthesize
from shields.runtime import one_step_test as one_step
from shields.runtime.one_step_test import OneStepTest
from shields.runtime.plane import PlaneOutlook
from tests.plants import random_plant

PLANTS = {"truck": truck_trailer(mass=4000.0)} | {
    f"{n}, {m}": random_plant(3, n, m) for n, m in ((2, 1), (3, 2), (4, 3))
}


@pytest.fixture(scope="module", params=PLANTS)
def case(request):
    plant = PLANTS[request.param]
    return plant, synthesize(plant)


def predicted(certificate, plant, shape):
    """The ellipsoid of next states around their center, in coordinates where M = I, and h."""
    root = np.linalg.cholesky(certificate.M).T
    first, second = root @ plant.A @ shape @ plant.A.T @ root.T, root @ plant.disturbance.shape @ root.T
    share = np.sqrt(np.trace(first)) / (np.sqrt(np.trace(first)) + np.sqrt(np.trace(second)))
    P = first / share + second / (1 - share)
    return root, P, np.sqrt(np.linalg.eigvalsh(P)[-1])


def cases(certificate, plant, rng, count):
    for _ in range(count):
        turn = rng.standard_normal((plant.n, plant.n))
        flat = turn @ np.diag(10.0 ** rng.uniform(-6, 0, plant.n)) @ turn.T
        shape = flat * rng.uniform(0.01, 1.0) / np.linalg.eigvalsh(np.linalg.solve(certificate.Sigma, flat)).real.max()
        estimate = 1.2 * certificate.safe_set.sample(rng)
        yield estimate, 0.5 * (shape + shape.T), rng.uniform(-1, 1, plant.m) * plant.u_max * rng.random()


def test_room_is_that_of_the_formula(case):
    plant, certificate = case
    test, rng = OneStepTest(certificate.L, plant), np.random.default_rng(0)
    for estimate, shape, u in cases(certificate, plant, rng, 100):
        root, P, h = predicted(certificate, plant, shape)
        c = root @ (plant.A @ estimate + plant.B @ u)
        room, margin = test.at(estimate, shape).judge(u.tolist())
        if h < 1.0:
            weight = (1 - h) * h * np.linalg.inv(h * np.eye(plant.n) - P)
            assert room == pytest.approx(1 - h - np.sqrt(c @ weight @ c), abs=1e-9)
        assert margin == pytest.approx(1 - h - np.linalg.norm(c), abs=1e-9)
        assert room >= margin - 1e-12


def test_the_test_lies_between_the_sufficient_and_the_exact_one(case):
    plant, certificate = case
    test, rng = OneStepTest(certificate.L, plant), np.random.default_rng(1)
    sharper = agree = exactly = 0
    for estimate, shape, u in cases(certificate, plant, rng, 400):
        root, P, h = predicted(certificate, plant, shape)
        room, margin = test.at(estimate, shape).judge(u.tolist())
        values, axes = np.linalg.eigh(P)
        c = axes.T @ root @ (plant.A @ estimate + plant.B @ u)
        best = np.inf
        if h < 1.0:
            found = minimize_scalar(
                lambda s, c=c, values=values: (c**2 * s / (s - values)).sum() + s,
                bounds=(values[-1] * (1 + 1e-9), 1.0),
                method="bounded",
                options={"xatol": 1e-10},
            )
            best = found.fun
        exact = best <= 1.0
        if margin >= 0.0:
            assert room >= 0.0
        if room >= 1e-6:
            assert exact
        sharper += room > margin + 1e-6
        exactly += exact and room < 0.0
        agree += exact and room >= 0.0
    assert agree > 50
    assert exactly < 0.05 * agree  # little is lost against the exact test
    assert sharper > 50


def test_passing_inputs_are_the_ones_the_worst_case_allows(case):
    # By another route: ascent over the errors and disturbances themselves, not over an ellipsoid around them.
    plant, certificate = case
    test, rng = OneStepTest(certificate.L, plant), np.random.default_rng(2)
    tight = 0.0
    for estimate, shape, u in cases(certificate, plant, rng, 60):
        outlook = test.at(estimate, shape)
        outward = outlook.closest(u.tolist(), 0.0)
        if outward is None:
            continue
        errors, center = Ellipsoid(shape), plant.A @ estimate + plant.B @ np.array(outward)
        for _ in range(10):
            e, d = errors.sample_boundary(rng), plant.disturbance.sample_boundary(rng)
            for _ in range(30):
                slope = certificate.M @ (center - plant.A @ e + d)
                e, d = errors.extreme_point(-plant.A.T @ slope), plant.disturbance.extreme_point(slope)
            level = certificate.safe_set.gauge(center - plant.A @ e + d)
            tight = max(tight, level)
            assert level <= 1.0 + 1e-9
    assert tight > 0.9


def test_smallest_room_is_that_of_the_worst_input(case):
    plant, certificate = case
    test, rng = OneStepTest(certificate.L, plant), np.random.default_rng(3)
    for estimate, shape, _ in cases(certificate, plant, rng, 30):
        outlook = test.at(estimate, shape)
        inputs = rng.uniform(-1, 1, (500, plant.m)) * plant.u_max
        corners = np.sign(inputs) * plant.u_max
        smallest = outlook.smallest_room()
        assert all(outlook.judge(u.tolist())[0] >= smallest - 1e-12 for u in inputs)
        assert min(outlook.judge(u.tolist())[0] for u in corners) == pytest.approx(smallest, abs=1e-12)


def test_plain_floats_agree_with_arrays():
    plant = PLANTS["truck"]
    certificate = synthesize(plant)
    fast = OneStepTest(certificate.L, plant)
    slow = copy(fast)
    slow._plane = None
    rng = np.random.default_rng(4)
    reached = 0
    for estimate, shape, u in cases(certificate, plant, rng, 2000):
        a, b = fast.at(estimate, shape), slow.at(estimate, shape)
        assert isinstance(a, PlaneOutlook)
        assert not isinstance(b, PlaneOutlook)
        assert a.radius == pytest.approx(b.radius, abs=1e-12)
        np.testing.assert_allclose(a.judge(u.tolist()), b.judge(u.tolist()), atol=1e-11)
        assert a.smallest_room() == pytest.approx(b.smallest_room(), abs=1e-11)
        first, second = a.closest(u.tolist(), 1e-9), b.closest(u.tolist(), 1e-9)
        assert (first is None) == (second is None)
        if first is not None:
            reached += 1
            np.testing.assert_allclose(first, second, atol=1e-7)
    assert reached > 500


def test_plain_floats_take_off_as_much_for_rounding_as_arrays_do():
    # As if float64 had five digits, for asymmetric shapes (which are rounding, too).
    plant = PLANTS["truck"]
    fast = OneStepTest(synthesize(plant).L, plant)
    *most, _, limit = fast._plane
    fast.rounding, fast._plane = 1e-5, (*most, 1e-5, limit)
    slow = copy(fast)
    slow._plane = None
    rng = np.random.default_rng(5)
    for estimate, shape, u in cases(synthesize(plant), plant, rng, 200):
        shape[0, 1] *= 1.0 - 1e-4
        a, b = (test.at(100.0 * estimate, shape) for test in (fast, slow))
        assert a.radius == pytest.approx(b.radius, abs=1e-6)
        np.testing.assert_allclose(a.judge(u.tolist()), b.judge(u.tolist()), rtol=1e-6)


@pytest.mark.parametrize("size", [1e-12, 1e-3, 1.0])
@pytest.mark.parametrize("key", ["truck", "3, 2"])
def test_nothing_is_said_about_indefinite_shapes_of_any_size(key, size):
    plant = PLANTS[key]
    test, shape = OneStepTest(np.eye(plant.n), plant), 1e-3 * size * np.eye(plant.n)
    assert test.at(np.zeros(plant.n), shape) is not None
    shape[0, 1] = shape[1, 0] = 1.001 * shape[0, 0]
    assert test.at(np.zeros(plant.n), shape) is None


@pytest.mark.parametrize("key", ["truck", "3, 2"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nothing_is_said_about_what_is_not_finite(key, bad):
    plant = PLANTS[key]
    test = OneStepTest(np.eye(plant.n), plant)
    shape, estimate = 0.01 * np.eye(plant.n), np.zeros(plant.n)
    assert test.at(estimate, shape) is not None
    for i in range(plant.n):
        broken = estimate.copy()
        broken[i] = bad
        assert test.at(broken, shape) is None
        for j in range(plant.n):
            broken = shape.copy()
            broken[i, j] = broken[j, i] = bad
            assert test.at(estimate, broken) is None


@pytest.mark.parametrize("key", ["truck", "3, 2"])
def test_nothing_is_said_about_wrong_shapes_or_negative_ones(key):
    plant = PLANTS[key]
    test = OneStepTest(np.eye(plant.n), plant)
    assert test.at(np.zeros(plant.n + 1), np.eye(plant.n)) is None
    assert test.at(np.zeros((plant.n, 1)), np.eye(plant.n)) is None
    assert test.at(np.zeros(plant.n), np.eye(plant.n + 1)) is None
    assert test.at(np.zeros(plant.n), np.ones(plant.n)) is None
    assert test.at(np.zeros(plant.n), -np.eye(plant.n)) is None


def test_decomposition_that_fails_says_nothing(monkeypatch):
    plant = PLANTS["3, 2"]
    test = OneStepTest(np.eye(3), plant)

    monkeypatch.setattr(one_step, "dsyev", lambda matrix: (np.ones(3), np.eye(3), 1))
    assert test.at(np.zeros(3), 0.01 * np.eye(3)) is None


def test_one_state_leaves_nothing_to_be_sharper_about():
    plant = random_plant(3, 1, 1)
    certificate = synthesize(plant)
    test, rng = OneStepTest(certificate.L, plant), np.random.default_rng(0)
    for estimate, shape, u in cases(certificate, plant, rng, 50):
        *_, h = predicted(certificate, plant, shape)
        room, margin = test.at(estimate, shape).judge(u.tolist())
        center = abs(plant.A @ estimate + plant.B @ u).item() / np.sqrt(certificate.L.item())
        assert room == pytest.approx(margin, abs=1e-12)
        assert room == pytest.approx(1.0 - h - center, abs=1e-9)


def test_bounds_on_rounding_hold_column_by_column():
    # A plant whose states differ much in size, and a disturbance that is far from the unit ball of the safe set.
    A = np.array([[0.5, 40.0, 0.0], [0.0, 0.4, -300.0], [0.0, 0.0, 0.3]])
    plant = replace(random_plant(3, 3, 2), A=A)
    L = np.diag([4.0, 9.0, 1.0]) + 0.5
    test = OneStepTest(L, plant)
    G, D = np.abs(test.root), plant.disturbance.shape
    columns = G @ np.abs(A)
    for i in range(3):
        assert test.columns[i] == pytest.approx(np.linalg.norm(columns[:, i]))
        assert test.own_columns[i] == pytest.approx(np.linalg.norm(G[:, i]))
    extent = np.linalg.norm(G, axis=0) @ np.sqrt(np.diag(D))
    room = np.linalg.eigvalsh(test.D - test.root @ D @ test.root.T)
    np.testing.assert_allclose(room, test.rounding * extent**2, rtol=0.2)
    # The radius is smaller by what rounding does to the estimate, its error and the input.
    estimate, shape = np.array([1.0, 2.0, -1.0]), 1e-7 * np.diag([1.0, 2.0, 3.0])
    for state, error in (
        (estimate, shape),
        (1e3 * estimate, shape),
        (0.0 * estimate, shape),
        (0.0 * estimate, 10 * shape),
    ):
        found = test.at(state, error)
        reach, spread = test.columns @ np.abs(state), test.columns @ np.sqrt(np.diag(error))
        pushed = np.linalg.norm(G @ np.abs(plant.B), axis=0) @ plant.u_max
        loss = 1.0 - found.h - found.radius
        assert found.h < 1.0
        assert loss == pytest.approx(test.rounding * (reach + spread + pushed), abs=3e-16)


def test_perfect_estimate_and_huge_error_are_handled(case):
    plant, certificate = case
    shield = SafetyFilter(certificate, plant)
    perfect = shield.decide(np.zeros(plant.n), np.zeros((plant.n, plant.n)), np.zeros(plant.m))
    assert perfect.reason == "safe"
    huge = shield.decide(np.zeros(plant.n), 1e12 * np.eye(plant.n), np.zeros(plant.m))
    assert not huge.passed
    assert huge.fallback
