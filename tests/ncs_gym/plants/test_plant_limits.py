"""The safe box, and limits around an operating point."""

import numpy as np
import pytest

from ncs_gym.limits import ChosenLimitsWarning
from tests.product import linear_plant

QUIET = {"disturbance_bound": 0.01, "sensor_bound": 0.01, "initial_bound": 0.01}
MODEL = {"A": [[0.9, 0.1], [0.0, 0.8]], "B": [[0.0], [0.5]], "u_max": 1.0, "dt": 0.1} | QUIET
ROOM = {"A": [[0.9]], "B": [[0.2]], "operating_state": [20.0], "operating_input": [10.0]} | QUIET | {"dt": 60.0}


def test_half_widths_and_rows_say_the_same():
    widths = linear_plant(**MODEL, box=[2.0, 0.5])
    rows = linear_plant(**MODEL, box=[[0.5, 0.0], [0.0, 2.0]])
    np.testing.assert_array_equal(widths.box, [[0.5, 0.0], [0.0, 2.0]])
    assert widths.fingerprint == rows.fingerprint
    np.testing.assert_allclose(widths.constraint_values(np.array([2.0, -0.25])), [0.0, -0.5])


def test_number_limits_every_state_alike_and_infinity_none():
    np.testing.assert_array_equal(linear_plant(**MODEL, box=4.0).box, 0.25 * np.eye(2))
    np.testing.assert_array_equal(linear_plant(**MODEL, box=[np.inf, 4.0]).box, [[0.0, 0.25]])


def test_limits_around_an_operating_point_keep_both_ends():
    plant = linear_plant(**ROOM, state_limits=(18.0, 25.0), input_limits=(0.0, 12.0), input_names=["heating"])
    np.testing.assert_allclose(plant.box_ends.T / plant.box, [[-2.0, 5.0]])
    np.testing.assert_allclose(1.0 / plant.box, [[3.5]])
    np.testing.assert_allclose(plant.input_ends, [[-10.0], [2.0]])
    np.testing.assert_array_equal([*plant.operating_state, *plant.operating_input], [20.0, 10.0])
    assert not plant.is_symmetric


def test_values_of_a_constraint_are_distances_beyond_the_nearer_end_in_units_of_half_the_range():
    limits = {"state_limits": ([-1.0, -2.0], [3.0, np.inf]), "u_max": 1.0}
    plant = linear_plant(**MODEL | limits, output_limits=[([1.0, 1.0], -np.inf, 4.0)])
    for x, expected in (
        ([0.0, 0.0], [-0.5, -1.0, -1.0]),
        ([4.0, -3.0], [0.5, 0.5, -0.75]),
        ([-1.5, 6.0], [0.25, -4.0, 0.125]),
    ):
        np.testing.assert_allclose(plant.constraint_values(np.array(x)), expected)
        np.testing.assert_allclose(plant.constraint_values(np.array([x, x]).T), np.array([expected] * 2).T)


def test_actions_reach_both_ends_and_never_beyond():
    for low, high in ((-10.0, 2.0), (-0.3, 0.7), (-1e-3, 1e3), (-np.pi, 0.1)):
        plant = linear_plant(**ROOM | {"operating_input": [0.0]}, box=1.0, input_limits=(low, high))
        middle, half = plant.input_middle, plant.input_half
        assert low <= (half * -1.0 + middle).item() <= low + 1e-15 * (high - low)
        assert high - 1e-15 * (high - low) <= (half * 1.0 + middle).item() <= high


def test_own_limits_are_the_closest_of_each_state_alone():
    rows = [[1.0, 0.0, 0.0], [-2.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.0, 0.0, 4.0]]
    limits = [(row, low, high) for row, low, high in zip(rows, (-1, -4, -1, -np.inf), (5, 6, 1, 2), strict=True)]
    plant = linear_plant(A=0.5 * np.eye(3), B=np.ones((3, 1)), u_max=1.0, dt=0.1, output_limits=limits, **QUIET)
    np.testing.assert_allclose(plant.own_limits, [[-1.0, -np.inf, -np.inf], [2.0, np.inf, 0.5]])


def test_half_widths_are_chosen_where_inputs_alone_are_limited():
    """What |u| <= 2 moves from rest in two steps is .4 and .2; a hundred times that is far beyond what counts."""
    model = {"A": [[1.0, 1.0], [0.0, 1.0]], "B": [[0.1], [0.05]], "dt": 0.1} | dict.fromkeys(QUIET, 0.0)
    with pytest.warns(ChosenLimitsWarning, match=r"half-widths \[50.0, 20.0\] were chosen"):
        plant = linear_plant(**model, u_max=2.0)
    np.testing.assert_allclose(plant.box, np.diag([1.0 / 50.0, 1.0 / 20.0]))
    with pytest.warns(ChosenLimitsWarning):
        same = linear_plant(**model, u_max=2.0, state_limits=(-np.inf, [np.inf, np.inf]))
    assert same.fingerprint == plant.fingerprint


def test_state_without_a_limit_has_the_size_that_its_own_units_and_inputs_give_it():
    """Not that of the limits of others: in micrometers the same state is a million times as large."""
    settings = {"dt": 0.1, "u_max": 1.0, "disturbance_bound": 0.0, "sensor_bound": 0.0, "initial_bound": 0.0}
    A, B = np.array([[0.9, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    in_meters = linear_plant(A=A, B=B, box=[1.0, np.inf], **settings)
    units = np.array([1.0, 1e6])
    in_micrometers = linear_plant(A=A * units[:, None] / units, B=B * units[:, None], box=[1.0, np.inf], **settings)
    np.testing.assert_allclose(in_micrometers.half_widths, in_meters.half_widths * units, rtol=1e-12)
