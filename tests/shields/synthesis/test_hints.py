"""Single changes that a refusal names are followed: each of them has a certificate, and a refusal comes in time."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.published import contract_of_plant, plant_of
from ncs_gym import ChannelContract, Ellipsoid, ErrorSetError, LinearPlant, certified_error_set
from shields import Infeasible, synthesize
from shields.synthesis import certification
from shields.synthesis.certification import LONGEST_REFUSAL
from shields.synthesis.diagnosis import Clock
from tests.certificates import feasible_bounds_not_sought
from tests.plants import servo
from tests.verdicts import verified

QUIET = {"sensor_bound": 0.01, "initial_bound": 0.01}
PENDULUM = {
    "A": [[1.1, 0.1], [0.1, 1.0]], "B": [[0.0], [0.1]], "dt": 0.1, "box": [0.3, 1.0], "u_max": 5.0,
    "sensor_bound": 1e-3, "initial_bound": (np.eye(2), [1e-3, 1e-3]),
}  # fmt: skip
ANGLE = {"A": [[1.0, 0.1], [-0.045, 0.9]], "B": [[0.0], [0.1]], "dt": 0.1}
ROOM = {"A": [[0.98]], "B": [[0.05]], "dt": 60.0, "operating_state": 22.0, "operating_input": 8.0}


def tanks(**changes):
    given = {
        "state_limits": ([0.0, 0.0], [16.0, 8.0]),
        "input_limits": ([0.0, 0.0], [10.0, 8.0]),
        "operating_state": [12.4, 5.0],
        "operating_input": [7.0, 3.0],
        "disturbance_bound": 1.5,
    }
    return LinearPlant.from_statespace(
        ([[-0.1, 0.05], [0.0, -0.2]], [[0.1, 0.02], [0.03, 0.2]], np.eye(2), 0), 1.0, **QUIET | given | changes
    )


def platoon(disturbance):
    """Three cars, each with its spacing, speed difference and acceleration."""
    A, B = np.zeros((9, 9)), np.zeros((9, 3))
    for i in range(3):
        A[3 * i, 3 * i + 1], A[3 * i + 1, 3 * i + 2], A[3 * i + 2, 3 * i + 2], B[3 * i + 2, i] = 1.0, -1.0, -2.0, 2.0
        if i:
            A[3 * i + 1, 3 * i - 1] = 1.0
    return LinearPlant.from_statespace(
        (A, B, np.eye(9), 0), 0.1, box=np.tile([5.0, 3.0, 3.0], 3), u_max=3.0,
        disturbance_bound=np.tile([0.0, disturbance, 0.001], 3), sensor_bound=0.02, initial_bound=0.02,
    )  # fmt: skip


# Refused plants, the age that their network promises, and what is named among what would help.
QUICK = {
    "disturbance": (PENDULUM | {"disturbance_bound": [0.05, 0.3]}, 0, {"disturbance_bound_factor"}),
    "room": (
        ROOM | QUIET | {"state_limits": (20.0, 24.0), "input_limits": (0.0, 12.0), "disturbance_bound": 0.7},
        2,
        {"disturbance_bound_factor", "share_of_radii"},
    ),
    "one end": (
        ROOM | QUIET | {"state_limits": (20.0, np.inf), "input_limits": (0.0, 12.0), "disturbance_bound": 0.7},
        2,
        {"disturbance_bound_factor", "u_max_1_factor"},
    ),
    "angle with a rate": (
        ANGLE | QUIET | {
            "state_limits": ([-0.5, -0.5], [0.8, 0.5]), "input_limits": (-2.0, 1.0),
            "disturbance_bound": [0.01, 0.03], "du_max": 0.01,
        },
        1,
        {"mixed_limit_1_factor"},
    ),
}  # fmt: skip
SLOW = {"room": pytest.mark.slow, "one end": pytest.mark.slow, "angle with a rate": pytest.mark.slow}
LONG = {
    "sensor": (lambda: LinearPlant(**PENDULUM | {"disturbance_bound": 1e-3, "sensor_bound": 0.2}), 0),
    "age": (lambda: LinearPlant(**PENDULUM | {"disturbance_bound": 1e-3}), 25),
    "servo": (lambda: servo(1.0, dt=0.01, disturbance_bound=[0.0, 0.5], u_max=0.5), 0),
    "servo between samples": (lambda: servo(1.0, dt=0.01, disturbance_bound=[0.0, 0.48], between_samples=4), 2),
    "tanks": (tanks, 2),
    "tanks with coupled valves": (lambda: tanks(mixed_limits=[([0.0, 0.0], [1.0, 1.0], 9.0, 11.0)]), 2),
    "platoon far off": (lambda: platoon(0.15), 2),
    "platoon nearly": (lambda: platoon(0.045), 2),
    **{
        name: (lambda name=name: plant_of(name), contract_of_plant(name).max_age)
        for name in ("ctms_suspension", "double_integrator", "afti16")
    },
}


def made(given):
    arguments = dict(given)
    du_max = arguments.pop("du_max", None)
    plant = LinearPlant(**arguments)
    return plant if du_max is None else plant.with_rate_limits(du_max)


def followed(plant, contract, name, value):
    """The plant and the contract with one change that the details of a refusal name."""
    if name == "max_age":
        return plant, replace(contract, max_age=value)
    if name == "largest_gamma":
        return replace(plant, gamma=value), contract
    what = name.removesuffix("_factor")
    if name == "share_of_radii":
        for each in ("disturbance_bound", "sensor_bound", "initial_bound"):
            plant, contract = followed(plant, contract, f"{each}_factor", value)
        return plant, contract
    if what.startswith("u_max_"):
        ends = plant.input_ends.copy()
        ends[:, int(what[6:]) - 1] *= value
        return replace(plant, input_ends=ends), contract
    if what == "box":
        return replace(plant, box=plant.box / value), contract
    if what.startswith(("box_row_", "mixed_limit_")):
        field = "box" if what.startswith("box") else "mixed_rows"
        rows = getattr(plant, field).copy()
        rows[int(what.split("_")[-1]) - 1] /= value
        return replace(plant, **{field: rows}), contract
    return replace(plant, **{what: Ellipsoid(value**2 * getattr(plant, what).shape_matrix)}), contract


def refusal(plant, contract):
    """Why a plant is refused; in time."""
    began = time.thread_time()
    with pytest.raises(Infeasible) as caught:
        synthesize(plant, contract=contract)
    assert time.thread_time() - began < LONGEST_REFUSAL
    return caught.value


def require_hints_that_certify(plant, contract, told):
    for name, value in told.details.items():
        if name != "pair_factor":
            changed, promised = followed(plant, contract, name, value)
            with feasible_bounds_not_sought():
                assert verified(synthesize(changed, contract=promised), changed).valid, name


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW.get(name, ())) for name in QUICK])
def test_each_single_change_that_a_refusal_names_has_a_certificate(name):
    given, age, expected = QUICK[name]
    plant, contract = made(given), ChannelContract(age)
    told = refusal(plant, contract)
    assert expected <= told.details.keys()
    for key in expected:
        shown = told.details[key] * (100.0 if key == "share_of_radii" else 1.0)
        assert f"{shown:.3g}" in str(told)
    require_hints_that_certify(plant, contract, told)


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_each_change_has_a_certificate_of_more_plants(name, monkeypatch):
    monkeypatch.setattr(certification, "LONGEST_REFUSAL", 3.0 * LONGEST_REFUSAL)  # whatever else the machine does
    make, age = LONG[name]
    plant, contract = make(), ChannelContract(age)
    with pytest.raises(Infeasible) as told:
        synthesize(plant, contract=contract)
    assert told.value.details
    require_hints_that_certify(plant, contract, told.value)


def test_limits_that_bind_are_named():
    plant = made(QUICK["room"][0])
    with feasible_bounds_not_sought(), pytest.raises(Infeasible, match=r"those that bind: 20 <= x1 <= 24 ") as told:
        synthesize(plant, contract=ChannelContract(2))
    assert told.value.__suppress_context__  # one error with one percentage


@pytest.mark.parametrize("speed_only", [[[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]]])
def test_less_age_is_not_named_where_a_state_is_not_seen(speed_only):
    chain = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    for limits in ({"box": [1.0, 1.0, 1.0]}, {"state_limits": ([-1.0, -1.0, -1.0], [2.0, 1.0, 1.0])}):
        plant = LinearPlant.from_statespace(
            (chain, [[0.0], [0.0], [1.0]], speed_only, 0), 0.1, u_max=1.0, disturbance_bound=1e-4,
            state_names=("place", "speed", "acceleration"), **limits, **QUIET,
        )  # fmt: skip
        told = refusal(plant, ChannelContract(3))
        assert "the outputs do not show place" in str(told)
        assert "age" not in str(told)
        assert not told.details


def test_error_sets_that_no_age_has_are_told_from_those_of_less_age():
    seen_alone = {"A": np.eye(2), "H": [[0.0, 1.0]], "disturbance_bound": 1e-4}
    unseen = LinearPlant(**PENDULUM | seen_alone)
    with pytest.raises(ErrorSetError, match="the outputs do not show x1"):
        certified_error_set(unseen, ChannelContract(2))
    with pytest.raises(ErrorSetError, match="promise less age"):
        certified_error_set(
            LinearPlant(**PENDULUM | {"A": [[2.0, 0.1], [0.1, 1.0]], "disturbance_bound": 1e-5}), ChannelContract(400)
        )


def test_clock_that_has_run_out_ends_a_search():
    clock = Clock(time.thread_time() + 1e3)
    clock.check("a line of progress")
    assert not clock.part(100).is_over
    with pytest.raises(TimeoutError):
        Clock(time.thread_time() - 1.0).check()


@pytest.mark.slow
def test_a_contract_is_named_where_a_stable_plant_has_none():
    plant = LinearPlant(
        A=[[0.998]], B=[[0.01]], H=[[1.0]], dt=0.1, state_limits=([0.2], [0.9]), input_limits=([0.0], [1.0]),
        operating_state=[0.5], operating_input=[0.1], disturbance_bound=([[1.0]], [-0.001], [0.001]),
        sensor_bound=0.01, initial_bound=0.02,
    )  # fmt: skip
    with pytest.raises(Infeasible, match=r"a contract of the channel \(contract=ChannelContract\(32\)") as refused:
        synthesize(plant)
    assert verified(synthesize(plant, contract=ChannelContract(refused.value.details["max_age"])), plant).valid


def test_less_age_is_named_where_it_helps():
    plant = LinearPlant(**PENDULUM | {"A": [[2.0, 0.1], [0.1, 1.0]], "disturbance_bound": 1e-5})
    told = refusal(plant, ChannelContract(400))
    assert "promise less age" in str(told)
    assert f"max_age = {told.details['max_age']} or less" in str(told)
    require_hints_that_certify(plant, ChannelContract(400), told)
