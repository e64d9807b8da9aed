import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize, minimize_scalar

from ncs_gym import Ellipsoid
from ncs_gym.ellipsoid import farthest_coordinates, is_inside, joined, outer_sum, outside_sum
from shields.verification.rational_matrix import is_positive_semidefinite, rational, subtract

seeds = st.integers(0, 10_000)


def random_shape(rng: np.random.Generator, n: int, rank: int | None = None) -> np.ndarray:
    factor = rng.standard_normal((n, n if rank is None else rank))
    return factor @ factor.T


@given(seeds, st.integers(1, 6))
@settings(max_examples=50, deadline=None)
def test_extreme_point_attains_support_and_no_sample_exceeds_it(seed, n):
    rng = np.random.default_rng(seed)
    ellipsoid = Ellipsoid(random_shape(rng, n))
    direction = rng.standard_normal(n)
    best = ellipsoid.extreme_point(direction)
    assert direction @ best == pytest.approx(ellipsoid.support(direction))
    assert ellipsoid.gauge(best) == pytest.approx(1.0, abs=1e-6)
    assert all(direction @ ellipsoid.sample(rng) <= ellipsoid.support(direction) for _ in range(50))


def test_gauge_is_the_mahalanobis_norm_in_whatever_units():
    rng = np.random.default_rng(1)
    shape, point = random_shape(rng, 3), rng.standard_normal(3)
    assert Ellipsoid(shape).gauge(point) == pytest.approx(np.sqrt(point @ np.linalg.inv(shape) @ point))
    units = np.array([1e-6, 1.0, 1e6])
    scaled = Ellipsoid(shape * np.outer(units, units)).gauge(point * units)
    assert scaled == pytest.approx(Ellipsoid(shape).gauge(point))


def test_flat_ellipsoid_contains_only_its_plane():
    flat = Ellipsoid(np.outer([1.0, 2.0], [1.0, 2.0]))
    assert flat.contains([0.5, 1.0])
    assert not flat.contains([0.5, 1.0 + 1e-9])
    point = Ellipsoid(np.zeros((2, 2)))
    assert point.contains([0.0, 0.0])
    assert not point.contains([0.0, 1e-300])
    axis, points = Ellipsoid(np.diag([4.0, 0.0])), np.array([[1.0, 0.0], [1.0, 1e-300], [0.0, -1.0]])
    np.testing.assert_array_equal(axis.gauge(points), [0.5, np.inf, np.inf])
    np.testing.assert_array_equal([axis.gauge(each) for each in points], [0.5, np.inf, np.inf])


def test_points_off_a_flat_ellipsoid_have_no_gauge_in_whatever_direction_it_lies():
    rng = np.random.default_rng(4)
    for _ in range(20):
        shape = random_shape(rng, 4, rank=2)
        flat, off = Ellipsoid(shape), np.linalg.svd(shape)[0][:, -1]
        inside = 0.5 * flat.extreme_point(rng.standard_normal(4))
        assert flat.gauge(inside) == pytest.approx(0.5)
        points = np.array([inside, inside + 1e-6 * off])
        assert flat.gauge(points[1]) == np.inf
        np.testing.assert_allclose(flat.gauge(points), [0.5, np.inf])


@pytest.mark.parametrize("size", [1, 3, 5])
def test_many_samples_fill_the_ellipsoid_evenly(size):
    rng = np.random.default_rng(5)
    ellipsoid = Ellipsoid(random_shape(rng, size))
    share = np.mean(ellipsoid.gauge(ellipsoid.sample(rng, 8000)) <= 0.8)
    assert share == pytest.approx(0.8**size, abs=0.02)


@given(seeds, st.integers(1, 5))
@settings(max_examples=8, deadline=None)
def test_farthest_point_beats_local_search_from_many_starts(seed, n):
    rng = np.random.default_rng(seed)
    ellipsoid, weight = Ellipsoid(random_shape(rng, n)), random_shape(rng, n)
    center = rng.standard_normal(n) * rng.choice([0.0, 1e-9, 1.0, 10.0])

    def value(point: np.ndarray) -> float:
        return float((center + point) @ weight @ (center + point))

    found = ellipsoid.farthest_point(center, weight)
    assert ellipsoid.gauge(found) <= 1.0 + 1e-9

    def on_boundary(s: np.ndarray) -> np.ndarray:
        return ellipsoid.factor @ (s / np.linalg.norm(s))

    for _ in range(6):
        local = minimize(lambda s: -value(on_boundary(s)), rng.standard_normal(n))
        assert value(found) >= -local.fun * (1.0 - 1e-7) - 1e-12


@given(seeds, st.integers(1, 5))
@settings(max_examples=50, deadline=None)
def test_outer_sum_holds_the_minkowski_sum(seed, n):
    rng = np.random.default_rng(seed)
    first, second = (Ellipsoid(random_shape(rng, n)) for _ in range(2))
    total = Ellipsoid(outer_sum(first.shape_matrix, second.shape_matrix, np.eye(first.dim)))
    for _ in range(30):
        direction = rng.standard_normal(n)
        assert total.support(direction) >= (first.support(direction) + second.support(direction)) * (1.0 - 1e-12)


def test_inclusion_has_no_tolerance_and_flat_sets_lie_in_one_another_where_they_have_the_same_plane():
    flat, other = np.diag([0.0, 1.0, 4.0]), np.diag([1.0, 0.0, 4.0])
    assert is_inside(0.5 * flat, flat)
    assert not is_inside(flat, 0.5 * flat)
    assert not is_inside(flat, other)
    assert is_inside(flat, np.diag([1.0, 1.0, 4.0]))
    for n in (2, 3):
        assert is_inside(np.eye(n), np.eye(n))
        assert not is_inside(np.eye(n) * (1.0 + 1e-15), np.eye(n))
        sheared = np.eye(n)
        sheared[0, 1] = sheared[1, 0] = 0.5
        assert not is_inside(sheared, np.eye(n))
    for n, rank in ((size, rank) for size in (1, 2, 3, 6) for rank in range(size + 1)):
        root = np.random.default_rng(rank).standard_normal((n, rank))
        assert is_inside(root @ root.T, root @ root.T)


@pytest.mark.parametrize("n", [2, 3, 4])
def test_what_is_said_to_be_inside_is_inside_in_exact_arithmetic(n):
    """Shapes that touch but for their last digits: a test in float64 alone calls half of those outside inside."""
    rng, outside, missed = np.random.default_rng(n), 0, 0
    for _ in range(80):
        root = rng.standard_normal((n, n - 1))
        touching = root @ root.T  # singular, but for rounding
        inner = np.zeros((n, n)) if rng.random() < 0.5 else np.diag(2.0 ** rng.integers(-3, 3, n))
        outer = inner + 0.5 * (touching + touching.T)
        exact = is_positive_semidefinite(subtract(rational(outer), rational(inner)))
        outside += not exact
        assert exact or not is_inside(inner, outer)
        missed += not is_inside(inner, outer + 1e-12 * np.eye(n))  # little enough is lost by being careful
    assert outside > 25
    assert missed == 0


@pytest.mark.parametrize("exponent", [0, -200, -537])
def test_inclusion_is_exact_where_differences_round_and_products_lose_their_digits(exponent):
    """The last digit of each entry of a difference decides, at 2^-537 beside products that keep no more than two."""
    rng, contradicted = np.random.default_rng(0), 0
    for _ in range(600):
        level = rng.integers(1, 6) + 0.5  # two neighbors of a product this large differ by one in its last digit
        d, b = np.sqrt(level) * rng.uniform(0.8, 1.25), np.nextafter(np.sqrt(level), 0.0)
        a = np.nextafter(level / d, np.inf)
        lost = 0.49 * 2.0**-52
        inner = lost * np.array([[1.0, -1.0], [-1.0, 1.0]])
        outer = np.ldexp([[a, b], [b, d]], exponent)
        inner = np.ldexp(inner, exponent)
        exact = is_positive_semidefinite(subtract(rational(outer), rational(inner)))
        assert exact or not is_inside(inner, outer)
        difference = outer - inner
        contradicted += not exact and difference[0, 0] * difference[1, 1] > difference[0, 1] ** 2
    assert contradicted > 0


@pytest.mark.parametrize("n", [1, 2, 5])
def test_joined_ellipsoid_holds_both_and_touches_each(n):
    rng = np.random.default_rng(n)
    first, second = (factor @ factor.T for factor in rng.standard_normal((2, n, n)))
    around = joined(first, second)
    for shape in (first, second):
        values = np.linalg.eigvals(np.linalg.solve(around, shape)).real
        assert values.max() <= 1.0 + 1e-9
        assert n == 1 or values.max() == pytest.approx(1.0)
    flat = np.zeros((n, n))
    np.testing.assert_allclose(joined(first, flat), first)


def sum_gauge(point, first, second):
    """sqrt(max over nu of r'(P1/nu + P2/(1-nu))^-1 r), a concave function of nu."""
    size = np.abs(np.diag(first)).max()
    point, first, second = point / size**0.5, first / size, second / size
    found = minimize_scalar(
        lambda nu: -Ellipsoid(first / nu + second / (1.0 - nu)).gauge(point),
        bounds=(1e-9, 1.0 - 1e-9),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return -found.fun


@pytest.mark.cases(3)
@pytest.mark.parametrize("size", [1, 2, 4])
@pytest.mark.parametrize("seed", [0, 3])
def test_points_outside_a_sum_are_found_as_by_minimization(seed, size):
    rng = np.random.default_rng(seed)
    first, second = random_shape(rng, size), 10.0 ** rng.uniform(-6, 6) * random_shape(rng, size)
    if seed == 3:
        first = np.outer(first[0], first[0])
    directions = rng.standard_normal((40, size))
    boundary = np.array([Ellipsoid(first).extreme_point(c) + Ellipsoid(second).extreme_point(c) for c in directions])
    factors = np.concatenate([1.0 + 10.0 ** rng.uniform(-7, 0, 20), 1.0 - 10.0 ** rng.uniform(-7, 0, 20)])
    points = factors[:, None] * boundary
    np.testing.assert_array_equal(outside_sum(points, first, second, 0.0), factors > 1.0)
    for point, factor in zip(points, factors, strict=True):
        if abs(factor - 1.0) > 1e-5:
            assert (sum_gauge(point, first, second) > 1.0) == (factor > 1.0)
    assert not outside_sum(boundary, first, second, 1e-9).any()
    # A tolerance is one of lengths.
    np.testing.assert_array_equal(outside_sum(1.09 * boundary[:5], first, second, 0.1), False)
    np.testing.assert_array_equal(outside_sum(1.11 * boundary[:5], first, second, 0.1), True)


def test_what_is_not_a_number_lies_outside_a_sum_and_a_flat_second_set_is_allowed():
    shape = np.diag([4.0, 1.0])
    points = np.array([[np.nan, 0.0], [np.inf, 0.0], [2.9, 0.0], [3.1, 0.0], [1e200, 0.0]])
    np.testing.assert_array_equal(outside_sum(points, shape, np.eye(2), 0.0), [True, True, False, True, True])
    flat = np.diag([1.0, 0.0])
    np.testing.assert_array_equal(outside_sum(points[2:], shape, flat, 0.0), [False, True, True])
    assert outside_sum(np.zeros((0, 2)), shape, flat, 0.0).dtype == np.bool_


def test_what_is_farthest_does_not_depend_on_the_points_it_is_found_with():
    rng, ellipsoid, weight = np.random.default_rng(0), Ellipsoid(np.diag([1.0, 2.0, 3.0])), np.diag([3.0, 1.0, 2.0])
    centers = rng.standard_normal((300, 3)) * 10.0 ** rng.uniform(-9, 2, (300, 3))
    centers[::7] = 0.0
    together = ellipsoid.farthest_point(centers, weight)
    alone = np.concatenate([ellipsoid.farthest_point(center[None], weight) for center in centers])
    np.testing.assert_array_equal(together, alone)


def largest_value(slope, values):
    """The most that s' diag(values) s + 2 slope's is for |s| <= 1: the least nu + sum slope_i^2 / (nu - value_i)."""
    pulls = slope != 0.0
    low, high = 0.0, float(np.linalg.norm(slope))
    while low < (middle := 0.5 * (low + high)) < high:
        length = np.linalg.norm(slope[pulls] / (values[-1] - values[pulls] + middle))
        low, high = (middle, high) if length > 1.0 else (low, middle)
    return values[-1] + high + np.sum(slope[pulls] ** 2 / (values[-1] - values[pulls] + high))


@pytest.mark.parametrize("last", [0.0, 1e-16, -1e-12, -1e-9, 1e-6])
def test_the_farthest_of_many_points_are_exact_at_and_near_the_hard_case(last):
    values = np.array([0.0, 1.0, 2.0])
    angles, sizes = np.meshgrid([0.0, 0.3, 1.2], [0.5, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 1.001])
    # Without the last entry, the solution at nu = max(values) is as long as `sizes`.
    slopes = np.stack([2.0 * sizes * np.sin(angles), sizes * np.cos(angles), np.full_like(sizes, last)], axis=-1)
    slopes = slopes.reshape(-1, 3)
    points = farthest_coordinates(slopes.T, values).T
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, rtol=1e-11)
    reached = points**2 @ values + 2.0 * np.sum(points * slopes, axis=1)
    wanted = [largest_value(slope, values) for slope in slopes]
    np.testing.assert_allclose(reached, wanted, rtol=2e-11)


@pytest.mark.parametrize("bad", [np.nan, -np.inf, 1e300, 5e-324])
@pytest.mark.parametrize("size", [0.0, 1e-300, 1e200])
def test_points_stay_inside_whatever_the_center(bad, size):
    ellipsoid = Ellipsoid(np.diag([1.0, 4.0, 9.0]))
    centers = np.array([[bad, 0.0, 0.0], [0.0, 0.0, bad], [1.0, bad, -bad]])
    points = ellipsoid.farthest_point(centers, size * np.diag([3.0, 2.0, 1.0]))
    assert ellipsoid.gauge(points).max() <= 1.0 + 1e-12
