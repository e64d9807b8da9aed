"""Units of states, inputs and outputs change no verdict, no share and no tolerated scale."""

from functools import cache

import numpy as np
import pytest

from ncs_gym import ChannelContract, Ellipsoid, LinearPlant
from shields import Infeasible, verify
from tests.plants import SOURCES, servo, small
from tests.product import linear_plant, synthesize
from tests.shields.polytope.limits import TANKS

BOUNDS = {"disturbance_bound": [1e-4, 1e-3], "sensor_bound": 1e-3, "initial_bound": [0.01, 0.02]}
MODEL = {"A": [[1.0, 0.1], [0.0, 0.98]], "B": [[0.0], [0.1]], "dt": 0.1, "H": [[1.0, 0.0]], "u_max": 1.0}
PLANTS = {
    "stable": (small([[0.9, 0.1], [0.0, 0.8]], gamma=0.0, disturbance_bound=[2e-3, 4e-3]), None),
    "bearable": (servo(0.8), ChannelContract(1)),
    "refused": (small([[0.9, 0.1], [0.0, 0.8]], gamma=0.0, disturbance_bound=[1.0, 2.0], u_max=0.1), None),
    "tanks": (TANKS, ChannelContract(1)),
    "free speed": (linear_plant(box=[1.0, np.inf], **MODEL, **BOUNDS), ChannelContract(1)),
}


def in_units(plant: LinearPlant, state: np.ndarray, applied: np.ndarray, output: np.ndarray) -> LinearPlant:
    """The plant with states, inputs and outputs in units that are so many times smaller; P0 has to be 0."""
    both = np.concatenate([state, applied])
    units = {"disturbance_bound": state, "initial_bound": state, "sensor_bound": output}
    bounds = {
        name: Ellipsoid(bound.shape_matrix * np.outer(unit, unit))
        for name, unit in units.items()
        if (bound := getattr(plant, SOURCES[name]).bound) is not None
    }
    return linear_plant(
        A=plant.A * state[:, None] / state,
        B=plant.B * state[:, None] / applied,
        H=plant.H * output[:, None] / state,
        dt=plant.dt,
        box=plant.box / state,
        box_ends=plant.box_ends,
        input_ends=plant.input_ends * applied,
        mixed_rows=plant.mixed_rows / both,
        mixed_ends=plant.mixed_ends,
        process_noise_cov=plant.process_noise.covariance * np.outer(state, state),
        measurement_noise_cov=plant.sensor_noise.covariance * np.outer(output, output),
        initial_cov=0.0 * plant.initial_noise.covariance,
        operating_state=plant.operating_state * state,
        operating_input=plant.operating_input * applied,
        **bounds,
    )


def drawn_units(plant: LinearPlant, seed: int, most: int = 6) -> tuple[np.ndarray, ...]:
    """Powers of ten up to 10^-most and 10^most."""
    rng = np.random.default_rng(seed)
    return tuple(10.0 ** rng.integers(-most, most + 1, count) for count in (plant.n, plant.m, plant.p))


def found(plant: LinearPlant, contract: ChannelContract | None) -> tuple[str, list[float]]:
    """The verdict, and the numbers that users read."""
    try:
        certificate = synthesize(plant, contract=contract)
    except Infeasible as infeasible:
        return infeasible.binding, [infeasible.shortfall]
    assert verify(certificate, plant).valid
    names = "share_of_box", "tolerated_scale"
    return "certified", [certificate.provenance.get(name, 0.0) for name in names]


@cache
def in_own_units(name: str) -> tuple[str, list[float]]:
    plant, contract = PLANTS[name]
    ones = (np.ones(count) for count in (plant.n, plant.m, plant.p))
    return found(in_units(plant, *ones), contract)


@pytest.mark.cases(2)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", PLANTS)
def test_verdict_share_and_tolerated_scale_are_the_same_in_other_units(name, seed):
    plant, contract = PLANTS[name]
    verdict, numbers = found(in_units(plant, *drawn_units(plant, seed)), contract)
    own_verdict, own_numbers = in_own_units(name)
    assert verdict == own_verdict
    assert (verdict == "certified") == (name != "refused")
    np.testing.assert_allclose(numbers, own_numbers, rtol=0.01)
