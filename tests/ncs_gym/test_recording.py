"""Bounds from a recording: what acted lies between them, and what a record cannot say is said."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest

from ncs_gym import Limits, LinearPlant, Model, Through, bounds_from_recording
from ncs_gym.plants import library
from ncs_gym.plants.library import batch_reactor
from ncs_gym.plants.lqr import lqr_gain
from tests.product import library_plant

# Plants, and by how much their sensors are made better, so that noise is less than half of what acts.
PLANTS = {"truck_trailer": 0.3, "cart_pole": 1, "convoy": 1}


def driven(model, steps, half, phi, *, E=None, seed=0, sizes=None, mismatch=1.0, swing=3.0):
    """Inputs, outputs and disturbances of a model about zero that a regulator and a sinusoid drive.

    Disturbances of a step are multiplied by `sizes` of the input, and the inputs by `mismatch`.
    """
    rng, (n, m), p = np.random.default_rng(seed), model.B.shape, len(model.H)
    E = np.eye(n) if E is None else E
    K, x, rows = lqr_gain(model.A, model.B, np.eye(n), np.eye(m)), np.zeros(n), []
    for k in range(steps):
        u = K @ x + swing * np.max(half) * np.sin(0.37 * k + np.arange(m)) * rng.uniform(size=m)
        s = rng.uniform(-1, 1, E.shape[1]) * half * (1.0 if sizes is None else sizes(u))
        rows.append((u, model.H @ x + rng.uniform(-1, 1, p) * phi, s))
        x = model.A @ x + mismatch * model.B @ u + E @ s
    u, y, s = map(np.array, zip(*rows, strict=True))
    return u, np.vstack([y, model.H @ x + rng.uniform(-1, 1, p) * phi]), s


def servo(H=((1.0, 0.0),)):
    return Model.sampled([[0, 1], [0, -0.5]], [[0], [1]], H, 0.1)


def case_of(name):
    """A plant whose states are measured, directions, half-widths of its disturbance and of its sensors."""
    plant = library_plant(getattr(library, name))
    part = plant.bounds.disturbance.parts[0]
    E = part.E if isinstance(part, Through) else None
    half = np.sqrt(np.diag(plant.disturbance.shape_matrix)) if E is None else part.set.half
    phi = np.full(plant.n, np.sqrt(plant.sensor_error.shape_matrix.diagonal().min()))
    if plant.p == plant.n:
        phi = np.sqrt(np.diag(plant.sensor_error.shape_matrix))
    return replace(plant.model, H=np.eye(plant.n)), E, half, PLANTS[name] * phi


@pytest.mark.parametrize("name", PLANTS)
def test_what_acted_lies_between_the_bounds_within_a_factor_of_two_where_states_are_measured(name):
    model, E, half, phi = case_of(name)
    u, y, s = driven(model, 250, half, phi, E=E)
    found, acted = bounds_from_recording(model, u, y, E, sensor=phi), np.abs(s).max(axis=0)
    assert (0.5 * acted <= found.lower).all()
    assert (found.lower <= acted).all()
    assert (acted <= found.upper).all()
    assert (found.upper <= 2.0 * acted).all()
    assert (found.lower <= (1 + 1e-5) * found.explaining).all()
    assert (found.explaining <= found.upper).all()
    assert found.grows == ()
    assert found.left.max() <= 0.05


def test_bounds_are_those_of_a_dense_program_and_of_the_corners_of_the_noise():
    model, phi, w = servo(np.eye(2)), np.array([0.001, 0.004]), np.array([3.0, 1.0])
    u, y, _ = driven(model, 40, np.array([0.004, 0.01]), phi)
    found = bounds_from_recording(model, u, y, sensor=phi, weights=w)
    theta, noise, told = oracle(model, u, y)
    within = [cp.abs(noise) <= np.tile(phi, (41, 1))]
    for i in range(2):
        assert found.lower[i] == pytest.approx(cp.Problem(cp.Minimize(theta[i]), told + within).solve(), rel=1e-3)
    assert w @ found.explaining == pytest.approx(cp.Problem(cp.Minimize(w @ theta), told + within).solve(), rel=1e-3)
    corners = [np.array(each) * np.tile(phi, 2) for each in itertools.product((-1, 1), repeat=4)]
    residual = y[1:] - y[:-1] @ model.A.T - u @ model.B.T
    largest = [np.abs(residual - v[2:] + model.A @ v[:2]).max(axis=0) for v in corners]
    assert found.upper == pytest.approx(np.max(largest, axis=0), rel=1e-5)


def oracle(model, u, y, E=None):
    """Half-widths, noise, and the equations of a record, for cvxpy: by states, with every variable there is."""
    E = np.eye(len(model.A)) if E is None else np.array(E)
    x, s, v = cp.Variable((len(y), len(E))), cp.Variable((len(u), E.shape[1])), cp.Variable(y.shape)
    moved = x[1:] == x[:-1] @ model.A.T + u @ model.B.T + s @ E.T
    return cp.max(cp.abs(s), axis=0), v, [moved, y == x @ model.H.T + v]


def test_outputs_alone_bound_disturbances_along_few_directions():
    model = library_plant(batch_reactor).model
    u, y, s = driven(model, 200, np.array([0.01, 0.02]), 1e-5, E=model.B)
    found = bounds_from_recording(model, u, y, model.B, sensor=1e-5)
    inner = np.abs(s[found.window : -found.window]).max(axis=0)
    assert found.window > 1
    assert (0.5 * inner <= found.lower).all()
    assert (found.lower <= np.abs(s).max(axis=0)).all()
    assert (inner <= found.upper).all()
    assert np.isfinite(found.upper).all()
    assert "unless one did within 7 steps of its ends." in " ".join(str(found).split())


def test_outputs_that_do_not_tell_a_direction_leave_no_upper_bound_of_it():
    u, y, s = driven(servo(), 100, np.array([0.001, 0.005]), 1e-4)
    found = bounds_from_recording(servo(), u, y, sensor=1e-4)
    assert (found.lower <= np.abs(s).max(axis=0)).all()
    assert np.isinf(found.upper).all()
    assert " none " in str(found)
    with pytest.raises(ValueError, match="these outputs leave no upper bound of x1: measure more"):
        found.bounds(2.0)
    with pytest.raises(ValueError, match="does not tell the state: give first_error"):
        found.bounds(2.0, of="explaining")
    assert found.bounds(2.0, of="explaining", first_error=0.1).disturbance.half == pytest.approx(2 * found.explaining)


@pytest.mark.parametrize(("sizes", "mismatch"), [(lambda u: np.abs(u), 1.0), (None, 1.3)])
def test_disturbances_that_grow_with_the_input_accuse_the_model(sizes, mismatch):
    model = servo(np.eye(2))
    u, y, _ = driven(model, 500, np.array([0.0, 0.01]), 1e-5, sizes=sizes, mismatch=mismatch, swing=100.0)
    found = bounds_from_recording(model, u, y, sensor=1e-5)
    (said,) = (each for each in found.grows if "disturbance x2" in each)
    assert said.startswith("The disturbance x2 grows with |u1|, by ")
    assert "mend the model, since no bound of this record holds" in " ".join(str(found).split())


def test_share_and_longest_run_of_the_second_half_beyond_the_first_are_those_that_were_made():
    model, rng = servo(np.eye(2)), np.random.default_rng(0)
    s = rng.uniform(-1, 1, (400, 2))
    s[[250, *range(300, 307)], 0] = 2.0
    x = [np.zeros(2)]
    for each in s:
        x.append(model.A @ x[-1] + each)
    found = bounds_from_recording(model, np.zeros((400, 1)), x, sensor=0)
    beyond = np.abs(s[200:]) > np.abs(s[:200]).max(axis=0)
    assert found.left == pytest.approx(beyond.mean(axis=0))
    assert found.left[0] >= 8 / 200
    assert f"up to {100.0 * found.left.max():.3g} % of the second half's steps may" in " ".join(str(found).split())


def test_records_are_in_the_units_of_the_model_and_inputs_act_after_its_delays():
    plain, phi = servo(np.eye(2)), 1e-4
    u, y, _ = driven(plain, 60, 0.01, phi)
    there = replace(plain, at=([3.0, -1.0], [5.0])).with_delays(2)
    late, shifted = np.vstack([u, np.zeros((2, 1))]) + 5.0, np.vstack([np.zeros((2, 2)), y]) + np.array([3.0, -1.0])
    moved = bounds_from_recording(there, late, shifted, sensor=phi)
    found = bounds_from_recording(plain, u, y, sensor=phi)
    assert moved.steps == found.steps == 60
    assert moved.upper == pytest.approx(found.upper)
    assert moved.lower == pytest.approx(found.lower, rel=1e-4)


def test_records_are_read_with_the_delay_of_each_channel():
    rng, E, half = np.random.default_rng(3), np.eye(2), np.array([0.01, 0.02])
    model = Model([[0.9, 0.1], [0.0, 0.8]], [[1.0, 0.5], [0.2, 1.0]], None, 0.1).with_delays([[3, 0], [1, 2]])
    u, x, acted = rng.normal(size=(200, 2)), [np.zeros(2)], rng.uniform(-half, half, (200, 2))
    for k in range(200):
        late = [[u[k - s, j] if k >= s else 0.0 for j, s in enumerate(row)] for row in model.delays]
        x.append(model.A @ x[-1] + (model.B * late).sum(axis=1) + acted[k])
    found = bounds_from_recording(model, u, x, E, sensor=1e-9)
    assert found.steps == 197
    assert found.upper == pytest.approx(np.abs(acted[3:]).max(axis=0), rel=1e-5)


def test_bounds_of_a_factor_make_a_plant():
    model = servo(np.eye(2))
    E, labels = np.array([[0.005], [0.1]]), {"states": {"angle": "rad", "rate": ""}, "inputs": {"volts": "V"}}
    u, y, _ = driven(model, 100, 0.01, 1e-3, E=E)
    found = bounds_from_recording(model, u, y, E, sensor=1e-3, labels=labels)
    bounds = found.bounds(1.5)
    assert bounds.disturbance.set.half == pytest.approx(1.5 * found.upper)
    assert bounds.sensor.half == pytest.approx([1e-3, 1e-3])
    assert bounds.first_error.half == pytest.approx([1e-3, 1e-3])
    assert found.outputs == ("angle", "rate")
    assert LinearPlant(model, Limits(state=[1, 2], input=2), bounds, labels).n == 2
    assert max(map(len, str(found).splitlines())) <= 80
    with pytest.raises(ValueError, match=r"factor must be a number >= 1, got 0\.5"):
        found.bounds(0.5)
    with pytest.raises(ValueError, match='of must be "upper" or "explaining"'):
        found.bounds(2, of="lower")


U, Y = np.zeros((30, 1)), np.random.default_rng(0).uniform(-1e-3, 1e-3, (31, 2))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "servo"}, "model must be a Model, got 'servo'"),
        ({"inputs": U[:20]}, "outputs must have as many rows as inputs, or one more, got 31 and 20"),
        ({"outputs": Y * np.nan}, "outputs must be finite"),
        ({"outputs": Y[:, :1]}, r"outputs must have shape \(any, 2\)"),
        ({"inputs": U[:19], "outputs": Y[:20]}, "the record is too short: it has 19 steps, 20 are needed"),
        ({"model": servo(np.eye(2)).with_delays(40)}, "the record is too short: it has 0 steps"),
        ({"E": [[1.0]]}, r"E must have shape \(2, any\)"),
        ({"E": [[1.0, 0.0], [0.0, 0.0]]}, "every direction of E must move a state, one is zero"),
        ({"sensor": -1.0}, r"sensor must be half-widths, a number or shape \(2,\), got -1.0"),
        ({"sensor": [np.nan, 1.0]}, "sensor must be half-widths"),
        ({"weights": [1.0]}, r"weights must be positive, shape \(2,\), got \[1.0\]"),
        ({"E": [[1.0], [0.0]], "sensor": 0.0}, "no disturbance along E and no sensor noise within its half-widths"),
        ({"model": servo([[0, 1]]), "outputs": Y[:, :1]}, "the model is not observable"),
    ],
)
def test_wrong_records_are_refused_in_a_sentence(change, words):
    with pytest.raises(ValueError, match=words):
        bounds_from_recording(**{"model": servo(np.eye(2)), "inputs": U, "outputs": Y, "sensor": 0.1} | change)
