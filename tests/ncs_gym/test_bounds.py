"""The sets that bound what is uncertain: all answer the same questions, and each owns what it refuses."""

import itertools
import json
import warnings
from fractions import Fraction
from functools import partial

import numpy as np
import pytest

from ncs_gym import Ellipsoid
from ncs_gym.bounds import Ball, Bounds, Box, Gaussian, Sum, Through, as_set
from ncs_gym.disturbances import diagonal_inside
from ncs_gym.plants.family import Remainder

E = np.array([[1.0, 0.5], [0.0, 2.0], [0.3, 0.0]])
LEFT_OUT = Remainder(Ellipsoid(np.eye(2)), True, "given")
SETS = {
    "half-widths": as_set([0.1, 2.0, 0.0]),
    "number": as_set(0.3),
    "box": Box([-0.1, 0.0, 1.0], [0.3, 0.0, 2.0]),
    "ball": Ball(0.4),
    "ellipsoid": Ellipsoid(np.diag([1.0, 4.0, 0.25])),
    "gaussian": Gaussian(np.diag([1.0, 2.0, 0.5]), 0.1),
    "through": Through(E, [0.1, 0.2]),
    "through a box": Through(E, Box([-0.1, 0.0], [0.3, 0.2])),
    "sum": Box([-0.1, 0.0, 1.0], [0.3, 0.0, 2.0]) + Ball(0.1) + Gaussian(1e-4 * np.eye(3), 0.05),
    "sum that begins with an ellipsoid": Ellipsoid(np.eye(3)) + Box(-1.0, 2.0),
}


def points(own, rng, count):
    if isinstance(own, Box):
        return rng.uniform(own.low, own.high, (count, own.size))
    if isinstance(own, Through):
        return points(own.set, rng, count) @ own.E.T
    if isinstance(own, Sum):
        return sum(points(each, rng, count) for each in own.parts)
    return own.ellipsoid().sample(rng, count)


@pytest.mark.parametrize("name", SETS)
def test_points_are_within_the_support_that_is_within_the_ellipsoid(name):
    rng, own = np.random.default_rng(0), SETS[name].sized(3)
    directions = rng.standard_normal((20, 3))
    around, supports = own.ellipsoid(np.diag([1.0, 2.0, 3.0])), own.support(directions)
    reached = ((points(own, rng, 4000) - own.middle) @ directions.T).max(axis=0)
    assert (reached <= supports * (1.0 + 1e-12)).all()
    assert (reached > 0.5 * supports).any()
    assert (supports <= around.support(directions) * (1.0 + 1e-12)).all()
    assert own.sized(3) is own


@pytest.mark.parametrize("name", SETS)
def test_file_of_a_set_has_every_number_of_it(name):
    read = as_set(json.loads(json.dumps(SETS[name].document)))
    assert type(read) is type(SETS[name])
    assert read.size == SETS[name].size
    np.testing.assert_array_equal(read.sized(3).middle, SETS[name].sized(3).middle)
    shapes = [each.sized(3).ellipsoid().shape_matrix for each in (read, SETS[name])]
    np.testing.assert_array_equal(*shapes)


def test_a_number_is_a_half_width_per_entry_and_a_ball_says_so():
    np.testing.assert_array_equal(as_set(0.5).sized(2).ellipsoid().shape_matrix, 0.5 * np.eye(2))
    np.testing.assert_array_equal(Ball(0.5).sized(2).ellipsoid().shape_matrix, 0.25 * np.eye(2))


@pytest.mark.parametrize("half_widths", [[0.1, 0.2], np.array([0.1, 0.2]), np.float64(0.1)])
def test_half_widths_are_added_to_a_set_from_both_sides(half_widths):
    for each in (half_widths + Ball(1.0), Ball(1.0) + half_widths):
        assert each.sized(2).support(np.array([0.0, 1.0])) == 1.0 + np.max(half_widths)


def test_supports_of_a_sum_add_up_and_its_middles_too():
    one, other = Box([-1.0, 0.0], [3.0, 4.0]), Through([[1.0], [1.0]], Box(0.0, 2.0))
    both = one + other
    np.testing.assert_array_equal(both.middle, [2.0, 3.0])
    assert both.support(np.array([1.0, -2.0])) == one.support(np.array([1.0, -2.0])) + 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Box([0.0, 1.0], [1.0]), r"of one size, .* got \(\[0.0, 1.0\], \[1.0\]\)"),
        (lambda: Box(1.0, 0.0), "low <= high"),
        (lambda: as_set(np.inf), "a box needs two ends, low <= high of one size, within 1e.37 of 0"),
        (lambda: Box(1e299, 1e299), "within 1e.37 of 0"),
        (lambda: Ball(-1.0), "the radius of a ball must be a number >= 0"),
        (lambda: Gaussian([[1.0, 2.0], [2.0, 1.0]], 0.1), "positive semidefinite"),
        (lambda: Through(E, [0.1, 0.2, 0.3]), "dimension 2 is needed, got one in dimension 3"),
        (lambda: Through([[1e-30]], 1e-30), "must be 0 or at least"),
        (lambda: Sum((Gaussian([[1.0]], 0.1), Gaussian([[1.0]], 0.1))), "one Gaussian"),
        (lambda: Box([0.0], [1.0]) + Box([0.0, 0.0], [1.0, 1.0]), "dimension 1 is needed, got one in dimension 2"),
        *((partial(as_set, given), "a set must be") for given in ([[1.0, 1.0], [1.0, 2.0]], {"Box": {"low": 0.0}})),
        (lambda: Bounds(0.1, "a", 0.0), r"Bounds\(sensor=...\): a set must be"),
        (lambda: Through(E, Ball(0.1)), "takes half-widths or a Box"),
        (lambda: Through(E, LEFT_OUT), "takes half-widths or a Box"),
        (lambda: Through(E, Sum(())), "takes half-widths or a Box"),
        (lambda: Sum(()).ellipsoid(), "a sum of no sets"),
        (lambda: Bounds(-0.1, 0.1, 0.1), r"disturbance=...\): a set must be a number >= 0, .* got -0.1"),
        (
            lambda: Bounds(0.1, Through([[1.0] * 3], Box([1e16, 0.9, -1e16], [1e16, 1.1, -1e16])), 0.1),
            "its middle at zero",
        ),
        (lambda: Bounds(0.1, Box(0.0, 0.2), 0.1), r"Bounds\(sensor=...\) must have its middle at zero, got 0.1"),
        (lambda: Bounds(0.1, Through([[1.0]], Box(0.0, 0.2)) + Ball(0.1), 0.1), "must have its middle at zero"),
        (lambda: Bounds(0.1, LEFT_OUT, 0.1).sums(2, 2), "may have one remainder, and others none"),
        (lambda: Bounds(LEFT_OUT + LEFT_OUT, 0.1, 0.1).sums(2, 2), "may have one remainder, and others none"),
        (lambda: Bounds(0.1, 0.1, [0.1, 0.2]).sums(3, 1), r"first_error=...\): a set in dimension 3 is needed"),
    ],
)
def test_what_is_no_set_is_refused(make, message):
    with pytest.raises(ValueError, match=message), warnings.catch_warnings(action="error"):
        make()


def test_half_widths_reach_both_ends_where_rounding_moves_the_middle():
    low = 1e6 + 1e-10 * np.arange(100.0)
    box = Box(low, low + np.linspace(1e-9, 3e-9, 100))
    exact = [[Fraction(each) for each in numbers.tolist()] for numbers in (box.low, box.high, box.middle, box.half)]
    assert all(middle - half <= low and high <= middle + half for low, high, middle, half in zip(*exact, strict=True))
    assert (0.5 * (box.high - box.low) < box.half).any()


def test_half_widths_give_the_smallest_ellipsoid_around_their_box():
    widths = np.array([0.1, 2.0, 30.0])
    bound = as_set(widths).ellipsoid()
    corners = [widths * signs for signs in itertools.product([-1.0, 1.0], repeat=3)]
    np.testing.assert_allclose(bound.gauge(corners), 1.0, rtol=1e-12)


@pytest.mark.parametrize(("w", "widths"), [(0.2, [0.2, 0.2]), ([0.2, 0.5], [0.2, 0.5])])
def test_directions_and_sizes_give_an_ellipsoid_around_every_combination(w, widths):
    E = np.array([[1.0, 2.0], [0.0, 1.0], [3.0, 0.0]])
    bound = Through(E, w).ellipsoid()
    combinations = [E @ (np.array(widths) * signs) for signs in itertools.product([-1.0, 1.0], repeat=2)]
    np.testing.assert_allclose(bound.gauge(combinations), 1.0, rtol=1e-9)
    assert bound.gauge([0.0, 1.0, 0.0]) == np.inf  # off the plane that E spans


@pytest.mark.parametrize(
    "shape", [np.diag([4.0, 0.0, 1.0]), [[2.0, 0.9, 0], [0.9, 1.0, 0], [0, 0, 3.0]], np.ones((3, 3))]
)
def test_diagonal_shape_lies_inside(shape):
    bound = Ellipsoid(shape)
    inside = diagonal_inside(bound)
    assert np.array_equal(inside, np.diag(np.diag(inside)))
    assert np.linalg.eigvalsh(bound.shape_matrix - inside)[0] >= -1e-12
