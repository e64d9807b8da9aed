"""A plant of three values, a model, limits and bounds, is the one of the arguments that say the same."""

import warnings

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import (
    Ball,
    Bounds,
    Box,
    Channel,
    Gaussian,
    Limits,
    LinearPlant,
    Model,
    MovedOperatingPointWarning,
    Through,
    truck_trailer,
)
from shields import SafetyShield

MOTOR = [[0.0, 1.0], [0.0, -20.0]], [[0.0], [40.0]], [[1.0, 0.0]]
STATES = {"angle": "rad", "rate": "rad/s"}
A, B = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [0.5]])
MODEL, ABOUT = Model(A, B, None, dt=0.1), Model(A, B, None, dt=0.1, at=([1.0, 2.0], 0.5))
LIMITS, BOUNDS = Limits(state=[1.0, 2.0], input=1.0), Bounds([0.01, 0.02], 0.01, 0.02)
QUIET = {"disturbance_bound": [0.01, 0.02], "sensor_bound": [0.01, 0.01], "initial_bound": [0.02, 0.02]}


def same(plant, other):
    assert plant.fingerprint == other.fingerprint
    assert plant.document == other.document


def servo():
    return LinearPlant(
        Model.sampled([[0, 1], [0, -20]], [[0], [40]], [[1, 0]], dt=0.005),
        Limits(state=[0.2, 4.0], input=12.0),
        Bounds(disturbance=[0, 0.25], sensor=5e-4, first_error=[1e-3, 0.05]),
    )


def test_servo_of_values_is_that_of_arguments_and_is_shielded():
    bounds = {"disturbance_bound": [0, 0.25], "sensor_bound": 5e-4, "initial_bound": [1e-3, 0.05]}
    same(servo(), LinearPlant.from_statespace((*MOTOR, 0), 0.005, box=[0.2, 4.0], u_max=12.0, **bounds))
    channel = Channel(loss=0.3, max_consecutive_losses=2)
    env = SafetyShield(gym.make("ncs_gym/LinearNCS-v0", plant=servo(), channel=channel))
    env.reset(seed=0)
    assert env.step(np.zeros(1, np.float32))[4]["shield_guaranteed"]


def test_truck_of_values_keeps_its_fingerprint():
    motion, push = [[0.0, 1.0], [-4.5, -4.6]], [[0.0], [1.0]]
    noise = {"process_noise_cov": 1e-4 * np.eye(2), "measurement_noise_cov": 1e-4 * np.eye(2)}
    labels = {"states": {"coupling stretch": "m", "stretch rate": "m/s"}, "inputs": {"truck acceleration": "m/s^2"}}
    gaussian = Gaussian(1e-4 * np.eye(2), 0.05)
    plant = LinearPlant(
        Model.sampled(motion, push, None, dt=0.5), Limits([2.0, 2.0], 4.0), Bounds(gaussian, gaussian, gaussian), labels
    )
    same(plant, truck_trailer(gamma=0.0, **noise))


def test_limits_around_a_point_are_absolute_and_keep_both_ends():
    plant = LinearPlant(
        ABOUT,
        Limits(([0.0, 1.0], [2.5, np.inf]), (0.0, 2.0), [([1.0, 1.0], None, 0.0, 4.0), ([1.0, 0.0], [1.0], 0.0, 3.0)]),
        BOUNDS,
    )
    settings = {
        "operating_state": [1.0, 2.0],
        "operating_input": 0.5,
        "state_limits": ([0.0, 1.0], [2.5, np.inf]),
        "input_limits": (0.0, 2.0),
        "output_limits": [([1.0, 1.0], 0.0, 4.0)],
        "mixed_limits": [([1.0, 0.0], [1.0], 0.0, 3.0)],
    }
    same(plant, LinearPlant(A=A, B=B, dt=0.1, **settings, **QUIET))


def test_constants_of_a_model_are_at_rest_at_its_point():
    x, u = np.array([1.0, 2.0]), np.array([0.5])
    c = x - A @ x - B @ u
    absolute = LinearPlant(Model(A, B, None, 0.1, (x, u), c), Limits((x - 1.0, x + 1.0), (u - 1.0, u + 2.0)), BOUNDS)
    settings = {"operating_state": x, "operating_input": u, "offset": c}
    limits = {"state_limits": (x - 1.0, x + 1.0), "input_limits": (u - 1.0, u + 2.0)}
    same(absolute, LinearPlant(A=A, B=B, dt=0.1, **settings, **limits, **QUIET))
    with pytest.raises(ValueError, match="no equilibrium"):
        Model(A, B, None, 0.1, (x, u), 2.0 * c)


def test_delays_rates_and_times_between_samples_are_those_of_arguments():
    late = LinearPlant(MODEL.with_delays(2), Limits([1.0, 2.0], 1.0, rate=0.3), BOUNDS)
    settings = {"A": A, "B": B, "dt": 0.1, "box": [1.0, 2.0], "u_max": 1.0} | QUIET
    same(late, LinearPlant(**settings, input_delay=2, du_max=0.3))
    between = Limits(state=[0.2, 4.0], input=12.0, between_samples=4)
    bounds = Bounds([0.0, 0.25], 5e-4, [1e-3, 0.05])
    assert LinearPlant(Model.sampled(*MOTOR, dt=0.005), between, bounds).grid_rows is not None


def test_disturbance_with_two_ends_moves_the_point():
    model, ends = Model.sampled(*MOTOR, dt=0.005), ([-0.1], [0.3])
    E = model.held([[0.0], [1.0]])
    with pytest.warns(MovedOperatingPointWarning):
        plant = LinearPlant(model, LIMITS, Bounds(Through(E, Box(*ends)), 0.01, 0.02))
    settings = {"sensor_bound": 0.01, "initial_bound": [0.02, 0.02], "disturbance_bound": (E, *ends)}
    with pytest.warns(MovedOperatingPointWarning):
        other = LinearPlant.from_statespace((*MOTOR, 0), 0.005, box=[1.0, 2.0], u_max=1.0, **settings)
    same(plant, other)


def test_sets_of_a_plant_hold_the_sum_of_all_that_is_declared():
    both = Box([-0.01, -0.02], [0.01, 0.02]) + Ball(0.005) + Gaussian(1e-6 * np.eye(2), 0.05)
    plant = LinearPlant(MODEL, LIMITS, Bounds(both, both, both))
    directions = np.random.default_rng(0).standard_normal((100, 2))
    for around in (plant.disturbance, plant.sensor_error, plant.initial_error):
        assert (around.support(directions) >= both.sized(2).support(directions)).all()


def test_zero_is_said_on_purpose_and_warns_of_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plant = LinearPlant(MODEL, LIMITS, Bounds(0, 0, 0))
    assert len(plant.assumptions) == 3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LinearPlant(MODEL, LIMITS, 0.1), "bounds must be a Bounds"),
        (lambda: LinearPlant(MODEL, Limits([1.0], 1.0), BOUNDS), "state limits must be a pair"),
        (lambda: LinearPlant(MODEL, LIMITS, Bounds([0.1] * 3, 0.1, 0.1)), r"Bounds\(disturbance=...\)"),
        (lambda: LinearPlant(MODEL, LIMITS, BOUNDS, gamma=0.1), "gamma belongs to one of them"),
        (lambda: LinearPlant(MODEL, LIMITS, BOUNDS, {"outputs": {}}), "labels must have names"),
        (lambda: LinearPlant(MODEL, LIMITS, BOUNDS, {"states": ["x", "y"]}), "a dictionary of names"),
        (lambda: LinearPlant(ABOUT, LIMITS, BOUNDS), "state limits are absolute beside at="),
        (lambda: LinearPlant(MODEL, Limits((-1.0, 5.0), 1.0), BOUNDS), "positive half-widths of shape"),
        (lambda: LinearPlant(MODEL, Limits([1.0, 2.0], (0.0, 5.0)), BOUNDS), "limits are absolute"),
        (lambda: LinearPlant(MODEL, Limits([1.0, 2.0], (-np.inf, 5.0)), BOUNDS), "input limits must be finite"),
        (lambda: LinearPlant(MODEL, Limits([1.0, 2.0], 1.0, [([0.0, 1.0], [0.0], -1.0, 1.0)]), BOUNDS), "something"),
        (lambda: LinearPlant(MODEL, Limits([1.0, 2.0], 1.0, between_samples=4), BOUNDS), "between_samples needs"),
        (lambda: Limits([1.0, 2.0]), "need input="),
        (lambda: Limits(input=1.0, rows=[([1.0], -1.0, 1.0)]), "rows of limits must be a list"),
        (lambda: Model(A, B, [[0.0, 0.0]], 0.1), "every row of H"),
        (lambda: Model(A, B, None, 0.1, at=3.0), "at must be a pair"),
        (lambda: MODEL.held(np.eye(2)), "in continuous time"),
        (lambda: MODEL.with_delays(-1), "delays must be a whole number"),
        (
            lambda: LinearPlant(MODEL, LIMITS, Bounds(Gaussian(np.eye(2), 0.1), Gaussian(np.eye(2), 0.2), 0.0)),
            "the same delta",
        ),
        (lambda: LinearPlant(MODEL, LIMITS, Bounds(Box(0.0, 0.1) + Ball(0.1), 0.0, 0.0)), "two different ends"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(make, message):
    with pytest.raises(ValueError, match=message) as refused:
        make()
    assert "\n" not in str(refused.value)
