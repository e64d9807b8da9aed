"""A plant as text: what people read, and files in which every number is exact."""

import json
import warnings

import numpy as np
import pytest

from ncs_gym import Ellipsoid, LinearPlant, cart_pole, truck_trailer
from ncs_gym.plants.library import batch_reactor
from ncs_gym.processes.cart_pole_process import nonlinear_cart_pole
from tests.plants import delayed
from tests.product import altered, linear_plant

ODD = linear_plant(
    A=[[0.1 + 0.2, 1 / 3], [1e-300 + 1e-20, np.pi / 10]],
    B=[[0.0], [1e-7]],
    box=[[1 / 3, 0.1], [0.0, 7.0]],
    u_max=2 / 3,
    dt=0.1,
    disturbance_bound=Ellipsoid([[0.1, 0.03], [0.03, 0.7]]),
    sensor_bound=([[1.0], [1 / 7]], 0.3),
    initial_bound=0.0,
    operating_state=[20.0, 0.0],
    operating_input=[1 / 3],
    state_names=["heat", "flow"],
    state_units=["K", ""],
)
QUIET = {"disturbance_bound": 0.01, "sensor_bound": 0.01, "initial_bound": 0.01}
STABLE = {"A": [[0.9, 0.1], [0.0, 0.8]], "B": [[0.0], [0.5]], "dt": 0.1} | QUIET
PLANTS = {
    "truck": truck_trailer(),
    "pole": cart_pole(full_state=False),
    "reactor": batch_reactor(),
    "odd": ODD,
    "between samples": altered(batch_reactor(), between_samples=4),
    "input delay": delayed(2),
    "remainder": nonlinear_cart_pole(),
    "two ends, one open": linear_plant(**STABLE, state_limits=([-1.0, -2.0], [3.0, np.inf]), input_limits=(-0.5, 2.0)),
    "rows of any signs": linear_plant(**STABLE, box=np.array([[-1.0, -2.0], [1.0, 3.0]]), u_max=1.0),
}


@pytest.mark.parametrize("name", PLANTS)
def test_file_gives_back_the_same_plant(name, tmp_path):
    plant = PLANTS[name]
    plant.save(tmp_path / "plant.json")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        twin = LinearPlant.load(tmp_path / "plant.json")
    assert (twin.fingerprint, twin.assumptions, str(twin)) == (plant.fingerprint, plant.assumptions, str(plant))
    assert (twin.state_names, twin.input_units) == (plant.state_names, plant.input_units)
    for bound in ("disturbance", "sensor_error", "initial_error"):
        np.testing.assert_array_equal(getattr(twin, bound).shape_matrix, getattr(plant, bound).shape_matrix)
    for array in ("box_ends", "input_ends", "box"):
        np.testing.assert_array_equal(getattr(twin, array), getattr(plant, array))
    np.testing.assert_array_equal(twin.step_rows, plant.step_rows)
    assert twin.document == plant.document == json.loads(json.dumps(plant.document, allow_nan=False))


def test_file_written_by_hand_takes_plain_terms(tmp_path):
    model = {"A": [[0.5]], "B": [[1]], "H": None, "dt": 0.1}
    limits, bounds = {"state": ["-inf", 2], "input": 1}, {"disturbance": 0.01, "sensor": [0.02], "first_error": 0.03}
    content = {"format": "ncs-gym plant 2", "model": model, "limits": limits, "bounds": bounds, "labels": None}
    (tmp_path / "plant.json").write_text(json.dumps(content))
    plant = LinearPlant.load(tmp_path / "plant.json")
    np.testing.assert_array_equal(plant.own_limits, [[-np.inf], [2.0]])
    bounds = plant.of_disturbance.bound, plant.of_sensor.bound, plant.of_first_error.bound
    assert [bound.shape_matrix[0, 0] ** 0.5 for bound in bounds] == pytest.approx([0.01, 0.02, 0.03])


def test_text_shows_limits_bounds_and_sampling_time_with_units():
    text = " ".join(str(cart_pole(dt=0.02)).split())
    for words in (
        "4 states, 1 input, 4 outputs, a step every 0.02 s",
        "not stable (spectral radius 1.09737): a certificate needs a contract of the channel",
        "|angle| <= 0.2 rad",
        "|force| <= 10 N",
        "disturbance position up to 0.00288 m, speed up to 0.0036 m/s",
        "first error position up to 2e-05 m",
        "Gaussian noise is truncated: the bounds hold 95 %",
    ):
        assert words in text
    assert "dynamics        stable (spectral radius 0.493817)" in str(truck_trailer())
