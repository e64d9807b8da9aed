"""Values that are wrong: a ValueError of one sentence, never another exception, never silently taken."""

import re
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ncs_gym import (
    AdversarialDisturbance,
    BallDisturbance,
    BoxDisturbance,
    Channel,
    ChannelContract,
    Ellipsoid,
    GilbertElliott,
    NCSVectorEnv,
    Regulation,
    SetpointTracking,
    SinusoidDisturbance,
    SpeedTracking,
    truck_trailer,
)
from ncs_gym.envs.env import NCSEnv
from shields import SafetyShield, VectorSafetyShield, synthesize, verify
from shields.runtime.filter import SafetyFilter
from tests.fuzz import NOTHING_USABLE, WRONG_NUMBERS, examples

PLANT = truck_trailer()
WRONG = [*NOTHING_USABLE, *WRONG_NUMBERS]
THREE = np.eye(3)
FRACTIONS = [1.5, np.float64(2.0), 1.0, 2**31, 10**30]
NOT_MATRICES = [*WRONG, np.full((2, 2), np.nan), np.eye(2) * 1e80, [[1, 2]], [[True, False], [False, True]], THREE]
NOT_COVARIANCES = [*NOT_MATRICES, -np.eye(2), [[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.1], [0.0, 1.0]]]
NOT_COVARIANCES += [np.diag([1e12, -1e-3]), [[1e12, 1.0], [1.0, 0.0]], [[1e12, 1e3], [1e3, 1e-8]]]
FLAGS = [*NOTHING_USABLE, 0, 1, 0.0, np.nan, "True", np.array([True])]


def but(values, *left_out):
    """The values that equal none of those left out."""
    return [each for each in values if not any(type(each) is type(other) and each == other for other in left_out)]


def setting(make, name, wrong):
    return [pytest.param(make, name, value, id=f"{make.__name__}.{name}-{i}") for i, value in enumerate(wrong)]


def counts(low):
    return [*WRONG, *FRACTIONS, low - 1]


def noisy(**changes):
    return replace(PLANT, **changes)


def environment(**changes):
    return NCSEnv(**({"plant": PLANT} | changes))


def vector(**changes):
    return NCSVectorEnv(**({"num_envs": 2, "plant": PLANT} | changes))


def setpoint(**changes):
    return SetpointTracking(**({"output": [1.0, 0.0], "reach": 1.0, "width": 1.0} | changes))


def bursts(**changes):
    return GilbertElliott(**({"p_good_to_bad": 0.1, "p_bad_to_good": 0.1} | changes))


BETWEEN = [*WRONG, 1.1, -1e-9]
CASES = [
    *[case for name in ("A", "B", "H") for case in setting(noisy, name, NOT_MATRICES)],
    *setting(noisy, "C", [*but(NOT_MATRICES, [[1, 2]]), np.zeros((1, 2)), np.ones((1, 3)), [[1e-80, 0.0]]]),
    *setting(noisy, "u_max", [*but(WRONG, [1.0]), 0.0, 1e-300, [1.0, 1.0], [[1.0]], [np.nan]]),
    *setting(noisy, "dt", [*WRONG, 0.0, 1e-80]),
    *setting(noisy, "gamma", WRONG),
    *setting(noisy, "delta", BETWEEN),
    *setting(noisy, "error_gain", but(NOT_MATRICES, [[1, 2]])),
    *[
        case
        for name in ("process_noise_cov", "measurement_noise_cov", "initial_cov")
        for case in setting(noisy, name, NOT_COVARIANCES)
    ],
    *[
        case
        for name in ("state_names", "state_units", "input_names", "input_units")
        for case in setting(noisy, name, [*but(WRONG, ["1"]), "ab", ["a"] * 3, [1, 2]])
    ],
    *[case for name in ("p_good_to_bad", "p_bad_to_good", "loss_good") for case in setting(bursts, name, BETWEEN)],
    *setting(Channel, "loss", [*BETWEEN, None]),
    *setting(Channel, "quantization_step", [*WRONG, 1e-300, None]),
    *setting(Channel, "send_period", counts(1)),
    *[case for name in ("delay", "jitter") for case in setting(Channel, name, [*counts(0), 1001, None])],
    *setting(Channel, "max_consecutive_losses", counts(0)),
    *setting(ChannelContract, "max_age", [*counts(0), None, 1001]),
    *[
        case
        for make, name in ((Regulation, "state_cost"), (AdversarialDisturbance, "M"), (Ellipsoid, "shape"))
        for case in setting(make, name, [each for each in NOT_COVARIANCES if each is not THREE])
    ],
    *[case for name in ("fastest", "error_weight", "input_weight") for case in setting(SpeedTracking, name, WRONG)],
    *setting(SpeedTracking, "input_index", counts(0)),
    *setting(setpoint, "output", [*but(WRONG, -1.0, [1.0]), [np.nan], [[1.0]]]),
    *[case for name in ("reach", "width") for case in setting(setpoint, name, [*WRONG, 0.0])],
    *setting(setpoint, "change_probability", BETWEEN),
    *setting(BoxDisturbance, "half_widths", [*but(WRONG, [1.0]), [-1.0, 0.0], [np.nan], []]),
    *setting(SinusoidDisturbance, "period", [*WRONG, 0.0, 1e-300]),
    *[
        case
        for make in (environment, vector)
        for name in ("channel", "task", "contract", "initial_set", "plant")
        for case in setting(make, name, [*WRONG, Channel, PLANT if name != "plant" else 3])
    ],
    *[
        case
        for make in (environment, vector)
        for case in setting(make, "disturbance", [*but(WRONG, [1.0]), "x", BallDisturbance, BoxDisturbance([1.0, 1.0])])
        if not callable(case.values[2]) or isinstance(case.values[2], type)
    ],
    *setting(environment, "initial_set", [Ellipsoid(np.eye(3))]),
    *setting(
        environment, "task", [SpeedTracking(input_index=1), setpoint(output=[1.0]), Regulation(state_cost=np.eye(3))]
    ),
    *setting(environment, "task", [SpeedTracking(fastest=1e39), setpoint(reach=1e39), setpoint(reach=1e-39)]),
    *[case for name in ("terminate_on_violation",) for case in setting(environment, name, FLAGS)],
    *setting(environment, "allow_assumption_violation", FLAGS),
    *setting(environment, "render_mode", [*WRONG, "cinema"]),
    *setting(environment, "horizon", [*counts(1), 100_001]),
    *setting(vector, "num_envs", [*counts(1), None]),
    *setting(vector, "max_episode_steps", counts(1)),
    *setting(vector, "autoreset_mode", WRONG),
    *setting(vector, "render_mode", WRONG),
]


def assert_refused(call):
    """One sentence of a ValueError that is ours: numpy's and scipy's say nothing about settings."""
    with pytest.raises(ValueError, match=r".") as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text
    assert not re.search(r"[.!?] [A-Z]", text), text
    assert len(text) < 600, text


@pytest.mark.parametrize(("make", "name", "value"), CASES)
def test_wrong_values_are_refused_in_one_sentence(make, name, value):
    assert_refused(lambda: make(**{name: value}))


@given(data=st.data())
@examples(120)
def test_matrices_with_one_wrong_entry_are_refused(data):
    name = data.draw(st.sampled_from(["A", "B", "C", "H", "process_noise_cov", "initial_cov", "u_max"]))
    array = np.array(getattr(PLANT, name))
    entry = data.draw(st.sampled_from(range(array.size)))
    array.flat[entry] = data.draw(st.sampled_from([np.nan, np.inf, -np.inf, 1e75, -1e300]))
    assert_refused(lambda: noisy(**{name: array}))
    texts = array.astype(object)
    texts.flat[entry] = data.draw(st.sampled_from(["1", None, 1j, [1.0], 10**400]))
    assert_refused(lambda: noisy(**{name: texts}))


@pytest.mark.parametrize("number", range(len(WRONG)))
def test_wrong_options_of_a_reset_are_refused_and_change_nothing(number):
    value = WRONG[number]
    for env in (environment(), vector()):
        env.reset(seed=3)
        before = env.np_random.bit_generator.state
        for options in ({"state": value}, {"state": [np.nan, 0.0]}, {"state": [1.0]}, {"other": value}, {1: 2}):
            assert_refused(lambda env=env, options=options: env.reset(options=options))
        if type(value) is not dict or value:
            assert_refused(lambda env=env: env.reset(options=value))
        assert env.np_random.bit_generator.state == before
    assert_refused(lambda: env.reset(options={"reset_mask": value}))


@pytest.mark.parametrize("number", range(len(WRONG)))
def test_wrong_arguments_of_shields_are_refused(number, certificate, loaded):
    value = WRONG[number]
    env = gym.make("ncs_gym/TruckTrailerCruise-v0").unwrapped
    assert_refused(lambda: SafetyShield(env, value))
    assert_refused(lambda: SafetyShield(env, certificate, mode=value))
    assert_refused(lambda: SafetyShield(value, certificate))
    assert_refused(lambda: VectorSafetyShield(value, certificate))
    assert_refused(lambda: VectorSafetyShield(vector(plant=loaded), value))
    assert_refused(lambda: SafetyFilter(certificate, value))
    assert_refused(lambda: verify(certificate, value))
    assert_refused(lambda: verify(value, loaded))
    assert_refused(lambda: synthesize(value))
    assert_refused(lambda: synthesize(loaded, method=value))
    assert_refused(lambda: synthesize(loaded, contract=value))
    assert_refused(lambda: SafetyShield(env, certificate, penalty=value))
