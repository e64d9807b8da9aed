"""What a refusal says, in time: the radii that would do, the limits that bind, the states that nothing shows."""

from __future__ import annotations

import time

import numpy as np
import pytest

from ncs_gym import ChannelContract, ErrorSetError
from ncs_gym.estimation.error_bound import certified_error_set
from shields import Infeasible
from tests.plants import with_radii
from tests.product import linear_plant, synthesize
from tests.verdicts import verified

# A refusal takes so long at most [s of the processor].
LONGEST_REFUSAL = 60.0
QUIET = {"sensor_bound": 0.01, "initial_bound": 0.01}
PENDULUM = {
    "A": [[1.1, 0.1], [0.1, 1.0]], "B": [[0.0], [0.1]], "dt": 0.1, "box": [0.3, 1.0], "u_max": 5.0,
    "sensor_bound": 1e-3, "initial_bound": (np.eye(2), [1e-3, 1e-3]),
}  # fmt: skip
ROOM = {"A": [[0.98]], "B": [[0.05]], "dt": 60.0, "operating_state": 22.0, "operating_input": 8.0}


# Refused plants, and the age that their network promises.
REFUSED = {
    "disturbance": (PENDULUM | {"disturbance_bound": [0.05, 0.3]}, 0),
    "room": (
        ROOM | QUIET | {"state_limits": (20.0, 24.0), "input_limits": (0.0, 12.0), "disturbance_bound": 0.7},
        2,
    ),
}  # fmt: skip


def refusal(plant, contract):
    """Why a plant is refused; in time."""
    began = time.thread_time()
    with pytest.raises(Infeasible) as caught:
        synthesize(plant, contract=contract)
    assert time.thread_time() - began < LONGEST_REFUSAL
    return caught.value


@pytest.mark.parametrize("name", ["disturbance", pytest.param("room", marks=pytest.mark.slow)])
def test_radii_that_a_refusal_names_have_a_certificate(name):
    given, age = REFUSED[name]
    plant, contract = linear_plant(**given), ChannelContract(age)
    told = refusal(plant, contract)
    share = 1.0 - told.shortfall
    assert 0.0 < share < 1.0
    assert f"shrink to {100.0 * share:.3g}% of those given" in str(told)
    smaller = with_radii(plant, 0.9 * share)
    assert verified(synthesize(smaller, contract=contract), smaller).valid


def test_limits_that_bind_are_named():
    plant = linear_plant(**REFUSED["room"][0])
    with pytest.raises(Infeasible, match=r"those that bind: 20 <= x1 <= 24 ") as told:
        synthesize(plant, contract=ChannelContract(2))
    assert told.value.__context__ is None  # one error with one percentage


def test_error_sets_that_no_age_has_are_told_from_those_of_less_age():
    seen_alone = {"A": np.eye(2), "H": [[0.0, 1.0]], "disturbance_bound": 1e-4}
    unseen = linear_plant(**PENDULUM | seen_alone)
    with pytest.raises(ErrorSetError, match="the outputs do not show x1"):
        certified_error_set(unseen, ChannelContract(2))
    with pytest.raises(ErrorSetError, match="promise less age"):
        certified_error_set(
            linear_plant(**PENDULUM | {"A": [[2.0, 0.1], [0.1, 1.0]], "disturbance_bound": 1e-5}), ChannelContract(400)
        )
