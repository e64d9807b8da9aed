"""A plant of a model, limits and bounds: what follows from them, and their documents."""

import json
from array import array
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import pytest

from ncs_gym import (
    Bounds,
    Box,
    FunctionProcess,
    Limits,
    LinearPlant,
    Model,
    Through,
)
from tests.product import gym_env

A, B = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [0.5]])
MODEL = Model(A, B, None, dt=0.1)
LIMITS, BOUNDS = Limits(state=[1.0, 2.0], input=1.0), Bounds([0.01, 0.02], 0.01, 0.02)


def test_constants_of_a_model_are_at_rest_at_its_point():
    x, u = np.array([1.0, 2.0]), np.array([0.5])
    c = x - A @ x - B @ u
    absolute = LinearPlant(Model(A, B, None, 0.1, (x, u), c), Limits((x - 1.0, x + 1.0), (u - 1.0, u + 2.0)), BOUNDS)
    np.testing.assert_array_equal(absolute.step_offset, np.abs(c))
    np.testing.assert_array_equal(absolute.operating_state, x)
    with pytest.raises(ValueError, match="no equilibrium"):
        Model(A, B, None, 0.1, (x, u), 2.0 * c)


def test_past_inputs_are_known_since_delays_and_rates_made_them():
    late = LinearPlant(MODEL.with_delays(2), Limits([1.0, 2.0], 1.0, rate=0.3), BOUNDS)
    assert (late.n, late.past, late.is_past_row.tolist()) == (4, 2, [False, False, True, True])
    x, u = np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.5])
    np.testing.assert_allclose(late.A @ x + late.B @ u, [*(A @ x[:2] + B[:, 0] * 0.3), 0.4, 0.5])
    np.testing.assert_allclose(late.mixed_rows @ [*x, *u], [0.1 / 0.3])
    assert not late.of_disturbance.bound.shape_matrix[2:].any()
    slow = LinearPlant(MODEL, Limits([1.0, 2.0], 1.0, rate=0.3), BOUNDS)
    assert (slow.n, slow.past) == (3, 1)
    assert LinearPlant(MODEL, Limits([1.0, 2.0], 1.0), BOUNDS).past == 0


@pytest.mark.parametrize("d", [3, [2, 0], [[0, 1], [3, 1]]], ids=["all", "per input", "per state and input"])
@pytest.mark.parametrize("e", [0, [2, 0, 1]], ids=["now", "late"])
def test_delays_of_each_channel_are_those_of_the_formula(d, e):
    rng = np.random.default_rng(0)
    H, B2, point = rng.normal(size=(3, 2)), rng.normal(size=(2, 2)), ([1.0, 2.0], [0.5, -0.5])
    model = Model(A, B2, H, 0.1, at=point).with_delays(d, e)
    held = len(model.A) - 2
    free = np.full(held, np.inf)
    limits = Limits(([-9.0, -9.0, *-free], [9.0, 9.0, *free]), ([-2.0] * 2, [2.0] * 2))
    plant = LinearPlant(model, limits, Bounds([0.1, 0.1, *np.zeros(held)], 0.01, np.full(2 + held, 0.1)))
    late, behind = np.broadcast_to(d, (2, 2)), np.broadcast_to(e, 3)
    np.testing.assert_allclose(plant.operating_state[: 2 + held], [1.0, 2.0, *np.repeat(H @ [1.0, 2.0], behind)])
    assert (plant.past, plant.p) == (2 * late.max(), 3)
    u, x, whole = rng.normal(size=(20, 2)), [np.zeros(2)], np.zeros(plant.n)
    for k in range(20):
        expected = [H[i] @ x[k - back] if k >= back else 0.0 for i, back in enumerate(behind)]
        np.testing.assert_allclose(plant.H @ whole, expected, atol=1e-12)
        acting = np.array([[u[k - s, j] if k >= s else 0.0 for j, s in enumerate(row)] for row in late])
        x.append(A @ x[k] + (B2 * acting).sum(axis=1))
        whole = plant.A @ whole + plant.B @ u[k]
    document = json.loads(json.dumps(plant.document))
    assert LinearPlant.load(document).fingerprint == plant.fingerprint


def test_a_process_moves_with_the_input_that_acts_then_and_takes_one_delay_per_input():
    B2 = np.array([[1.0, 0.2], [0.3, 1.0]])
    late = Model(A, B2, None, 0.1, at=([0.5, 0.0], [0.1, -0.1])).with_delays([2, 0])
    plant = LinearPlant(late, Limits(([-9.0, -9.0], [9.0, 9.0]), ([-1.0, -1.0], [1.0, 1.0])), Bounds(0.0, 0.0, 0.0))
    process = FunctionProcess(lambda x, u: A @ x + B2 @ u)  # in deviations, as everything
    own, other = (gym_env(plant=plant, process=each) for each in (None, process))
    assert own.reset(seed=0)[1]["state"] == pytest.approx(other.reset(seed=0)[1]["state"])
    for action in np.random.default_rng(1).uniform(-1.0, 1.0, (8, 2)):
        assert own.step(action)[4]["state"] == pytest.approx(other.step(action)[4]["state"], abs=1e-12)
    each = replace(plant, model=late.with_delays([[2, 0], [1, 0]]))
    with pytest.raises(ValueError, match=r"another process, .* needs one delay per input"):
        gym_env(plant=each, process=process)


def test_limits_of_states_and_inputs_together_are_of_the_input_that_acts_then():
    model, rows = Model(A, np.eye(2), None, 0.1), [([1.0, 0.0], [2.0, 0.0], -1.0, 1.0), ([0.0, 1.0], [1.0, 3.0], -1, 1)]
    plant = LinearPlant(model.with_delays([2, 0]), Limits([1.0, 2.0], 1.0, rows), BOUNDS)
    np.testing.assert_array_equal(plant.box[-1], [1.0, 0.0, 2.0, 0.0, 0.0, 0.0])  # u1 of two steps ago
    np.testing.assert_array_equal(plant.mixed_rows, [[0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 3.0]])
    with pytest.raises(ValueError, match="a limit of states and inputs together, needs one delay per input"):
        LinearPlant(model.with_delays([[2, 0], [1, 0]]), Limits([1.0, 2.0], 1.0, rows), BOUNDS)


@pytest.mark.filterwarnings("ignore::ncs_gym.limits.MovedOperatingPointWarning")
@pytest.mark.parametrize("seed", [3, 10, 18])
def test_what_the_point_lacks_of_rest_is_inside_where_large_pushes_cancel(seed):
    w = np.random.default_rng(seed).uniform(0.1, 1.0, 2)
    E = np.stack([1e12 * np.array([1.0, -w[0] / w[1]]), [0.01, 0.02]])
    plant = LinearPlant(Model(0.5 * np.eye(2), B, None, 0.1), LIMITS, Bounds(Through(E, Box(w, w)), 0, 0))

    def times(matrix, vector):
        return [sum(Fraction(a) * b for a, b in zip(row, vector, strict=True)) for row in matrix.tolist()]

    push = times(E, [*map(Fraction, w.tolist())])
    x, u = ([*map(Fraction, each.tolist())] for each in (plant.operating_state, plant.operating_input))
    terms = zip(times(plant.A, x), times(plant.B, u), push, x, strict=True)
    assert plant.disturbance.gauge([float(Ax + Bu + d - own) for Ax, Bu, d, own in terms]) <= 1.0


@pytest.mark.filterwarnings("ignore::ncs_gym.limits.MovedOperatingPointWarning")
@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e6])
def test_a_free_state_rests_at_the_same_point_in_any_unit(unit):
    def plant(size):
        limits = Limits(([-np.inf, -size], [np.inf, size]), 1.0)
        push = Box([-1e-3 * size, 0.099 * size], [1e-3 * size, 0.101 * size])
        model = Model([[0.5, 1.0], [0.0, 0.5]], [[0.0], [0.1 * size]], None, 0.1)
        return LinearPlant(model, limits, Bounds(push, 1e-3 * size, 1e-3 * size))

    one, other = plant(1.0), plant(unit)
    np.testing.assert_allclose(other.operating_state / unit, one.operating_state, rtol=1e-8)
    np.testing.assert_allclose(other.disturbance.shape_matrix / unit**2, one.disturbance.shape_matrix, rtol=1e-6)


def test_open_ends_alone_leave_the_reach_infinite():
    plant = LinearPlant(MODEL, Limits((-np.ones(2), np.full(2, np.inf)), ([-1.0], [0.5])), BOUNDS)
    assert plant.reach.tolist() == [np.inf, np.inf, 1.0]


class Pair(NamedTuple):
    low: object
    high: object


class OwnList(list):
    pass


@pytest.mark.parametrize("kind", [OwnList, np.array, lambda numbers: array("d", numbers)])
def test_numbers_of_a_plant_are_its_own_whatever_they_came_in(kind):
    low, at, row = kind([-1.0, -2.0]), kind([0.0, 1.0]), kind([1.0, 1.0])
    model = Model(A, B, None, 0.1, at=Pair(at, [0.0]))
    plant = LinearPlant(model, Limits(Pair(low, [3.0, 4.0]), (-1.0, 1.0), [(row, None, -2.0, 3.0)]), BOUNDS)
    for each in (low, at, row):
        each[0] = 0.5
    assert replace(plant, model=replace(model)).fingerprint == plant.fingerprint
    assert LinearPlant.load(json.loads(json.dumps(plant.document))).fingerprint == plant.fingerprint
