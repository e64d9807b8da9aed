from copy import copy

import numpy as np
import pytest

from ncs_gym import Ellipsoid, truck_trailer
from shields.runtime.set_test import ellipsoid_test
from tests.certificates import certificate_of, metric
from tests.plants import random_plant
from tests.product import altered, safety_filter
from tests.shields.edges import edge_of

PLANTS = {"truck": truck_trailer(mass=4000.0)} | {
    f"{n}, {m}": random_plant(3, n, m) for n, m in ((2, 1), (3, 2), (4, 3))
}


@pytest.fixture(
    scope="module", params=["truck", *(pytest.param(key, marks=pytest.mark.slow) for key in ("2, 1", "3, 2")), "4, 3"]
)
def case(request):
    plant = PLANTS[request.param]
    return plant, certificate_of(plant)


def predicted(certificate, plant, shape):
    """The ellipsoid of next states around their center, in coordinates where M = I, and h."""
    root = np.linalg.cholesky(metric(certificate)).T
    first, second = root @ plant.A @ shape @ plant.A.T @ root.T, root @ plant.disturbance.shape_matrix @ root.T
    share = np.sqrt(np.trace(first)) / (np.sqrt(np.trace(first)) + np.sqrt(np.trace(second)))
    P = first / share + second / (1 - share)
    return root, P, np.sqrt(np.linalg.eigvalsh(P)[-1])


def errors_of(test, shape):
    """What is known of one error shape, as a batch of one."""
    return test.predicted(shape[None], np.empty((0, *shape.shape)))


def reachable(test, estimate, shape):
    """The next states that one estimate and error shape allow, as a batch of one."""
    with np.errstate(all="ignore"):
        return test.reachable(estimate[:, None], errors_of(test, shape))


def margins(sets, u):
    """Of one input."""
    return tuple(each.item() for each in sets.margins(u[:, None]))


def nothing_is_known(test, estimate, shape):
    sets = reachable(test, estimate, shape)
    with np.errstate(all="ignore"):
        unknown = np.isnan([*margins(sets, np.zeros(test.plant.m)), *sets.smallest_test_margin()])
    return bool(unknown.all())


def cases(certificate, plant, rng, count):
    for _ in range(count):
        turn = rng.standard_normal((plant.n, plant.n))
        flat = turn @ np.diag(10.0 ** rng.uniform(-6, 0, plant.n)) @ turn.T
        shape = flat * rng.uniform(0.01, 1.0) / np.linalg.eigvalsh(np.linalg.solve(certificate.Sigma, flat)).real.max()
        estimate = 1.2 * certificate.safe_set.sample(rng)
        yield estimate, 0.5 * (shape + shape.T), rng.uniform(-1, 1, plant.m) * plant.largest_input * rng.random()


def test_margin_is_that_of_the_formula(case):
    plant, certificate = case
    test, rng = ellipsoid_test(certificate.safe_set.shape_matrix, plant), np.random.default_rng(0)
    for estimate, shape, u in cases(certificate, plant, rng, 100):
        root, P, h = predicted(certificate, plant, shape)
        c = root @ (plant.A @ estimate + plant.B @ u)
        test_margin, margin = margins(reachable(test, estimate, shape), u)
        if h < 1.0:
            weight = (1 - h) * h * np.linalg.inv(h * np.eye(plant.n) - P)
            assert test_margin == pytest.approx(1 - h - np.sqrt(c @ weight @ c), abs=1e-9)
        assert margin == pytest.approx(1 - h - np.linalg.norm(c), abs=1e-9)
        assert test_margin >= margin - 1e-12


def test_passing_inputs_are_the_ones_the_worst_case_allows(case):
    # By another route: ascent over the errors and disturbances themselves, not over an ellipsoid around them.
    plant, certificate = case
    test, rng = ellipsoid_test(certificate.safe_set.shape_matrix, plant), np.random.default_rng(2)
    tight = 0.0
    for estimate, shape, u in cases(certificate, plant, rng, 24):
        with np.errstate(all="ignore"):
            outward = reachable(test, estimate, shape).closest(u[:, None], 0.0)[:, 0]
        if np.isnan(outward).any():
            continue
        errors, center = Ellipsoid(shape), plant.A @ estimate + plant.B @ outward
        for _ in range(10):
            e, d = errors.sample_boundary(rng), plant.disturbance.sample_boundary(rng)
            for _ in range(30):
                slope = metric(certificate) @ (center - plant.A @ e + d)
                e, d = errors.extreme_point(-plant.A.T @ slope), plant.disturbance.extreme_point(slope)
            level = certificate.safe_set.gauge(center - plant.A @ e + d)
            tight = max(tight, level)
            assert level <= 1.0 + 1e-9
    assert tight > 0.9


def test_smallest_test_margin_is_that_of_the_worst_input(case, monkeypatch):
    plant, certificate = case
    test, rng = ellipsoid_test(certificate.safe_set.shape_matrix, plant), np.random.default_rng(3)
    for estimate, shape, _ in cases(certificate, plant, rng, 30):
        sets = reachable(test, estimate, shape)
        inputs = rng.uniform(-1, 1, (500, plant.m)) * plant.largest_input
        corners = np.sign(inputs) * plant.largest_input
        smallest = sets.smallest_test_margin().item()
        assert (sets.margins(inputs.T)[0] >= smallest - 1e-12).all()
        assert sets.margins(corners.T)[0].min() == pytest.approx(smallest, abs=1e-12)
        monkeypatch.setattr("shields.runtime.set_test.LARGEST_BLOCK", 1)
        assert sets.smallest_test_margin().item() == pytest.approx(smallest, abs=1e-12)
        monkeypatch.undo()


@pytest.mark.parametrize("size", [1e-12, 1e-3])
def test_nothing_is_said_about_shapes_that_are_indefinite_only_as_a_whole(size):
    # Each pair of states could be correlated like this; all three cannot.
    test = ellipsoid_test(np.eye(3), PLANTS["3, 2"])
    units = np.diag([1.0, 1e-3, 10.0])
    for correlation, known in ((-0.4999, True), (-0.5 - 1e-8, False), (-0.9, False)):
        shape = size * units @ (np.eye(3) + correlation * (1.0 - np.eye(3))) @ units
        assert nothing_is_known(test, np.zeros(3), shape) is not known


def test_decomposition_that_fails_says_nothing(monkeypatch):
    plant = PLANTS["3, 2"]
    test = ellipsoid_test(np.eye(3), plant)

    def fail(matrices):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(np.linalg, "eigh", fail)
    assert nothing_is_known(test, np.zeros(3), 0.01 * np.eye(3))


def test_what_cannot_be_used_spoils_no_other_shape_of_the_batch():
    plant = PLANTS["3, 2"]
    certificate = certificate_of(plant)
    test, good = ellipsoid_test(certificate.safe_set.shape_matrix, plant), 0.5 * certificate.Sigma
    swap = good + np.eye(3)[[1, 0, 2]]
    bad = [np.full((3, 3), np.nan), np.full((3, 3), np.inf), -good, 1e308 * np.eye(3), swap]
    errors = test.predicted(np.array([good, *bad, good]), certificate.error_shapes)
    np.testing.assert_array_equal(np.isfinite(errors.radius), [True, *[False] * 5, True])
    np.testing.assert_array_equal(errors.certified, [True, *[False] * 5, True])
    assert np.isnan(errors.own[0, 1:-1]).all()
    assert np.isnan(errors.half_widths[:, 1:-1]).all()
    alone = test.predicted(good[None], certificate.error_shapes)
    for array, one in zip(errors, alone, strict=True):
        np.testing.assert_allclose(array[..., 0], one[..., 0], rtol=1e-12)
        np.testing.assert_array_equal(array[..., 0], array[..., -1])


def test_bounds_on_rounding_hold_column_by_column():
    # A plant whose states differ much in size, and a disturbance that is far from the unit ball of the safe set.
    A = np.array([[0.5, 40.0, 0.0], [0.0, 0.4, -300.0], [0.0, 0.0, 0.3]])
    plant = altered(random_plant(3, 3, 2), A=A)
    L = np.diag([4.0, 9.0, 1.0]) + 0.5
    test = ellipsoid_test(L, plant)
    G, D = np.abs(test.root), plant.disturbance.shape_matrix
    columns = G @ np.abs(A)
    for i in range(3):
        assert test.columns[i] == pytest.approx(np.linalg.norm(columns[:, i]))
        assert test.own_columns[i] == pytest.approx(np.linalg.norm(G[:, i]))
    extent = np.linalg.norm(G, axis=0) @ np.sqrt(np.diag(D))
    rounding = np.linalg.eigvalsh(test.D - test.root @ D @ test.root.T)
    np.testing.assert_allclose(rounding, test.rounding * extent**2, rtol=0.2)
    # The radius is smaller by what rounding does to the estimate, its error and the input.
    estimate, shape = np.array([1.0, 2.0, -1.0]), 1e-7 * np.diag([1.0, 2.0, 3.0])
    still, certain, test.rounding = copy(test), copy(test), 1e-9  # as if float64 had nine digits
    still.rounding = certain.rounding = test.rounding
    still.pushed, certain.columns = 0.0, 0.0 * test.columns
    for state, error in ((estimate, shape), (1e3 * estimate, shape), (0.0 * estimate, 10 * shape)):
        known, reach = errors_of(test, error).radius.item(), test.columns @ np.abs(state)
        assert known - reachable(test, state, error).radius.item() == pytest.approx(test.rounding * reach, abs=3e-16)
        pushed = np.linalg.norm(G @ np.abs(plant.B), axis=0) @ plant.largest_input
        assert errors_of(still, error).radius.item() - known == pytest.approx(test.rounding * pushed, rel=1e-6)
        spread = test.rounding * test.columns @ np.sqrt(np.diag(error))  # which enlarges h a little, too
        assert spread < errors_of(certain, error).radius.item() - known < 2.0 * spread


@pytest.mark.parametrize("key", ["truck", "3, 2"])
def test_nothing_passes_where_the_radius_is_too_small_for_the_weights(key):
    plant = PLANTS[key]
    shield = safety_filter(certificate_of(plant), plant)
    still, u = np.zeros((plant.n, 1)), np.zeros(plant.m)
    # An error ellipsoid whose h is 5e-6 below 1.
    shape = edge_of(lambda size: shield.errors_of(size * np.eye(plant.n)).radius > 5e-6, 1e6, 80) * np.eye(plant.n)
    assert 4e-6 < shield.errors_of(shape).radius < 6e-6
    sets = shield.test.reachable(still, shield.errors_of(shape).batch())
    np.testing.assert_array_equal([sets.radius, *sets.margins(u[:, None])], 0.0)
    assert shield.decide(still[:, 0], shape, u).reason == "fallback"
    assert not shield.decide(still[:, 0], shape, u).proved
    assert shield.decide(still[:, 0], 0.9 * shape, u).proved
