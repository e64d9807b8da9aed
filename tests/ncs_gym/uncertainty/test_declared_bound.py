"""Ellipsoids around sets in plain terms, and points of boxes inside them."""

import itertools

import numpy as np
import pytest

from ncs_gym import Ellipsoid
from ncs_gym.bounds import Through, as_set
from ncs_gym.uncertainty.disturbances import diagonal_inside, sample_box


def test_half_widths_give_the_smallest_ellipsoid_around_their_box():
    widths = np.array([0.1, 2.0, 30.0])
    bound = as_set(widths).ellipsoid()
    corners = [widths * signs for signs in itertools.product([-1.0, 1.0], repeat=3)]
    np.testing.assert_allclose(bound.gauge(corners), 1.0, rtol=1e-12)


def test_state_without_disturbance_costs_the_others_nothing():
    np.testing.assert_allclose(as_set([0.1, 0.0, 0.3]).ellipsoid().shape_matrix, 2.0 * np.diag([0.01, 0.0, 0.09]))


@pytest.mark.parametrize(("w", "widths"), [(0.2, [0.2, 0.2]), ([0.2, 0.5], [0.2, 0.5])])
def test_directions_and_sizes_give_an_ellipsoid_around_every_combination(w, widths):
    E = np.array([[1.0, 2.0], [0.0, 1.0], [3.0, 0.0]])
    bound = Through(E, w).ellipsoid()
    combinations = [E @ (np.array(widths) * signs) for signs in itertools.product([-1.0, 1.0], repeat=2)]
    np.testing.assert_allclose(bound.gauge(combinations), 1.0, rtol=1e-9)
    assert bound.gauge([0.0, 1.0, 0.0]) == np.inf  # off the plane that E spans


def test_box_of_half_widths_is_drawn_from_to_its_edges_and_no_further():
    widths = np.array([0.1, 0.0, 30.0])
    samples = np.abs(sample_box(as_set(widths).ellipsoid(), np.random.default_rng(0), 2000))
    largest = samples.max(axis=1)
    assert (largest <= widths * (1 + 1e-12)).all()
    assert (largest >= 0.99 * widths).all()


def test_box_along_principal_axes_stays_inside_and_reaches_the_boundary():
    bound = Ellipsoid([[2.0, 0.9], [0.9, 1.0]])
    gauges = bound.gauge(sample_box(bound, np.random.default_rng(0), 5000).T)
    assert 0.95 < gauges.max() <= 1.0 + 1e-12


@pytest.mark.parametrize(
    "shape", [np.diag([4.0, 0.0, 1.0]), [[2.0, 0.9, 0], [0.9, 1.0, 0], [0, 0, 3.0]], np.ones((3, 3))]
)
def test_diagonal_shape_lies_inside(shape):
    bound = Ellipsoid(shape)
    inside = diagonal_inside(bound)
    assert np.array_equal(inside, np.diag(np.diag(inside)))
    assert np.linalg.eigvalsh(bound.shape_matrix - inside)[0] >= -1e-12
