"""Values that are wrong: a ValueError of one sentence, never another exception, never silently taken."""

import re

import numpy as np
import pytest

from ncs_gym import (
    AdversarialDisturbance,
    Ball,
    Bounds,
    BoxDisturbance,
    Channel,
    ChannelContract,
    Ellipsoid,
    Gaussian,
    GilbertElliott,
    Limits,
    LinearPlant,
    Model,
    NCSVectorEnv,
    Regulation,
    SetpointTracking,
    SinusoidDisturbance,
    SpeedTracking,
    truck_trailer,
)
from ncs_gym.disturbances import BallDisturbance
from ncs_gym.envs.env import NCSEnv
from tests.fuzz import NOTHING_USABLE, WRONG_NUMBERS

PLANT = truck_trailer()
WRONG = [*NOTHING_USABLE, *WRONG_NUMBERS]
THREE = np.eye(3)
FRACTIONS = [1.5, np.float64(2.0), 1.0, 2**31, 10**30]
NOT_MATRICES = [*WRONG, np.diag([1.0, np.nan]), np.eye(2) * 1e80, [[1, 2]], [[True, False], [False, True]], THREE]
NOT_COVARIANCES = [*NOT_MATRICES, -np.eye(2), [[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.1], [0.0, 1.0]]]
NOT_COVARIANCES += [np.diag([1e12, -1e-3]), [[1e12, 1.0], [1.0, 0.0]], [[1e12, 1e3], [1e3, 1e-8]]]
FLAGS = [*NOTHING_USABLE, 0, 1, 0.0, np.nan, "True", np.array([True])]


def but(values, *left_out):
    """The values that equal none of those left out."""
    return [each for each in values if not any(type(each) is type(other) and each == other for other in left_out)]


def counts(low):
    return [*WRONG, *FRACTIONS, low - 1]


def equations(**changes):
    return Model(**({"A": 0.5 * np.eye(2), "B": np.ones((2, 1)), "H": np.eye(2), "dt": 0.1} | changes))


def limited(**changes):
    return LinearPlant(PLANT.model, Limits(**({"state": [1.0, 2.0], "input": 1.0} | changes)), PLANT.bounds)


def gaussian(**changes):
    return LinearPlant(
        PLANT.model, PLANT.limits, Bounds(Gaussian(**{"covariance": np.eye(2), "delta": 0.1} | changes), 0.0, 0.0)
    )


def labelled(**changes):
    return LinearPlant(PLANT.model, PLANT.limits, PLANT.bounds, changes)


def environment(**changes):
    return NCSEnv(**({"plant": PLANT} | changes))


def vector(**changes):
    return NCSVectorEnv(**({"num_envs": 2, "plant": PLANT} | changes))


def setpoint(**changes):
    return SetpointTracking(**({"output": [1.0, 0.0], "reach": 1.0, "width": 1.0} | changes))


def bursts(**changes):
    return GilbertElliott(**({"p_good_to_bad": 0.1, "p_bad_to_good": 0.1} | changes))


BETWEEN = [*WRONG, 1.1, -1e-9]
COUNTS, POSITIVE_COUNTS = counts(0), counts(1)
NOT_DELAYS, NOT_POSITIVE = [*COUNTS, 1001, None], [*WRONG, 0.0]
NOT_COSTS = [each for each in NOT_COVARIANCES if each is not THREE]
NOT_LABELS = [*but(WRONG, {}), "ab", ["a"] * 3, {"a": 1}, {1: "a"}, {"a": "", "b": "", "c": ""}]
NOT_DISTURBANCES = [*but(WRONG, [1.0]), "x", BallDisturbance, BoxDisturbance([1.0, 1.0])]
NOT_DISTURBANCES = [each for each in NOT_DISTURBANCES if isinstance(each, type) or not callable(each)]
NOT_PARTS = [*WRONG, Channel, PLANT]
NOT_TASKS = [SpeedTracking(input_index=1), setpoint(output=[1.0]), Regulation(state_cost=np.eye(3))]
NOT_TASKS += [SpeedTracking(fastest=1e39), setpoint(reach=1e39), setpoint(reach=1e-39)]
# Of each setting, what it must not be.
REFUSED = {
    equations: {**dict.fromkeys(("A", "B", "H"), but(NOT_MATRICES, None, [[1, 2]])), "dt": [*WRONG, 0.0, 1e-80]},
    limited: {
        "state": [*but(WRONG, None), 0.0, 1e-300, [1.0, 1.0, 1.0], [[1.0]], [np.nan, 1.0]],
        "input": [*but(WRONG, [1.0]), 0.0, 1e-300, [1.0, 1.0], [[1.0]], [np.nan]],
        "rows": but(WRONG, ()),
        "rate": [*but(WRONG, [1.0]), 0.0, [1.0, 1.0]],
    },
    gaussian: {"covariance": NOT_COSTS, "delta": BETWEEN},
    Ball: {"radius": WRONG},
    labelled: dict.fromkeys(("states", "inputs"), NOT_LABELS),
    bursts: dict.fromkeys(("p_good_to_bad", "p_bad_to_good", "loss_good"), BETWEEN),
    Channel: {
        "loss": [*BETWEEN, None],
        "quantization_step": [*WRONG, 1e-300, None],
        "send_period": POSITIVE_COUNTS,
        **dict.fromkeys(("delay", "jitter"), NOT_DELAYS),
        "max_consecutive_losses": COUNTS,
        "on_request": FLAGS,
    },
    ChannelContract: {"max_age": [*COUNTS, None, 1001]},
    Regulation: {"state_cost": NOT_COSTS},
    AdversarialDisturbance: {"M": NOT_COSTS},
    Ellipsoid: {"shape_matrix": [*NOT_COSTS, [[np.nan]], np.ones((2, 3))]},
    SpeedTracking: {
        **dict.fromkeys(("fastest", "error_weight", "input_weight"), WRONG),
        "input_index": COUNTS,
    },
    setpoint: {
        "output": [*but(WRONG, -1.0, [1.0]), [np.nan], [[1.0]]],
        **dict.fromkeys(("reach", "width"), NOT_POSITIVE),
        "change_probability": BETWEEN,
    },
    BoxDisturbance: {"half_widths": [*but(WRONG, [1.0]), [-1.0, 0.0], [np.nan], []]},
    SinusoidDisturbance: {"period": [*WRONG, 0.0, 1e-300]},
    environment: {
        **dict.fromkeys(("channel", "contract"), NOT_PARTS),
        "task": [*NOT_PARTS, *NOT_TASKS],
        "initial_set": [*NOT_PARTS, Ellipsoid(np.eye(3))],
        "plant": [*WRONG, Channel, 3],
        "disturbance": NOT_DISTURBANCES,
        **dict.fromkeys(("terminate_on_violation", "allow_assumption_violation"), FLAGS),
        "render_mode": [*WRONG, "cinema"],
        "noise": [*WRONG, "Gaussian"],
        "horizon": [*POSITIVE_COUNTS, 100_001],
    },
    vector: {
        "num_envs": [*POSITIVE_COUNTS, None],
        "max_episode_steps": POSITIVE_COUNTS,
        **dict.fromkeys(("autoreset_mode", "render_mode"), WRONG),
    },
}
SETTINGS = [
    pytest.param(make, name, wrong, id=f"{make.__name__}.{name}")
    for make, settings in REFUSED.items()
    for name, wrong in settings.items()
]


# Where a message names another setting: the shape of an ellipsoid, what does not fit a matrix, a field of a task.
NAMED = {"shape_matrix": "shape", "A": "B must have shape", "H": "noise_cov must have shape", "task": ""}
NAMED |= {"B": "operating_input must have shape"}
NAMED |= {"disturbance": "the corner of the box"}


def assert_refused(call, what="it"):
    """Returns one sentence of a ValueError that is ours: numpy's and scipy's say nothing about settings."""
    try:
        call()
    except ValueError as error:
        text = str(error)
    except Exception as error:
        error.add_note(f"when this was given: {what}")
        raise
    else:
        pytest.fail(f"taken: {what}")
    assert text, what
    assert "\n" not in text, what
    assert not re.search(r"[.!?] [A-Z]", text), (what, text)
    assert len(text) < 600, (what, text)
    return text


@pytest.mark.parametrize(("make", "name", "wrong"), SETTINGS)
def test_wrong_values_of_a_setting_are_refused_in_one_sentence(make, name, wrong):
    for number, value in enumerate(wrong):
        what = f"value {number}, of type {type(value).__name__}"
        text = assert_refused(lambda value=value: make(**{name: value}), what)
        assert name in text or NAMED.get(name, name) in text, (what, text)
