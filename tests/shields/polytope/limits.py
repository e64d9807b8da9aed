"""Plants with limits of every kind behind a lossy network: two ends, rates, coupled inputs, feedthrough."""

from __future__ import annotations

import warnings

import numpy as np

from ncs_gym import Channel, LinearPlant, contract_of
from ncs_gym.limits import MovedOperatingPointWarning
from shields import Certificate
from tests.certificates import certificate_of
from tests.product import linear_plant, sampled_plant

QUIET = {"sensor_bound": 0.01, "initial_bound": 0.01}
CHANNEL = Channel(loss=0.3, max_consecutive_losses=1, send_period=2)
CONTRACT = contract_of(CHANNEL)
# A safety filter's angle, -30 to 45 degrees (AMPyC); two tanks with two valves; a hill that only goes up.
ANGLE = linear_plant(
    A=[[1.0, 0.1], [-0.045, 0.9]],
    B=[[0.0], [0.1]],
    dt=0.1,
    state_limits=([-0.52, -0.52], [0.79, 0.52]),
    input_limits=(-2.0, 1.0),
    disturbance_bound=[0.002, 0.004],
    **QUIET,
)
TANKS = sampled_plant(
    ([[-0.1, 0.05], [0.0, -0.2]], [[0.1, 0.02], [0.03, 0.2]], np.eye(2), 0),
    1.0,
    state_limits=([0.0, 0.0], [16.0, 8.0]),
    input_limits=([0.0, 0.0], [10.0, 8.0]),
    output_limits=[([1.0, 1.0], -np.inf, 23.0)],
    operating_state=[12.4, 5.0],
    operating_input=[7.0, 3.0],
    disturbance_bound=0.1,
    **QUIET,
)
with warnings.catch_warnings():
    warnings.simplefilter("ignore", MovedOperatingPointWarning)
    HILL = sampled_plant(
        ([[-0.01]], [[1.32]], [[1.0]], 0),
        0.1,
        state_limits=(0.0, 40.0),
        input_limits=(0.0, 1.0),
        operating_state=20.0,
        operating_input=0.17,
        disturbance_bound=([[1.0]], [-0.06], [0.0]),
        **QUIET,
    )
MODEL = ([[0.0, 1.0], [-0.5, -1.0]], [[0.0], [1.0]], np.eye(2), 0)
ONE_INPUT = {"state_limits": ([-0.5, -0.5], [0.8, 0.6]), "input_limits": (-2.0, 1.0), "disturbance_bound": 0.003}
TWO_INPUTS = {
    "A": [[0.9, 0.1], [0.0, 0.95]],
    "B": [[0.1, 0.02], [0.05, 0.2]],
    "dt": 0.5,
    "state_limits": ([0.0, 0.0], [10.0, 8.0]),
    "input_limits": ([0.0, -1.0], [8.0, 4.0]),
    "operating_state": [4.0, 4.0],
    "operating_input": [3.0, 1.0],
    "disturbance_bound": 0.02,
} | QUIET
ASYMMETRIC = {"angle": ANGLE, "tanks": TANKS, "hill": HILL}
MIXED = {
    "rates": sampled_plant(MODEL, 0.1, du_max=0.3, **ONE_INPUT, **QUIET),
    "rates of a late input": sampled_plant(MODEL, 0.1, input_delay=2, du_max=0.3, **ONE_INPUT, **QUIET),
    # What passengers feel: the second row of the model itself, from -.6 to .4.
    "feedthrough": sampled_plant(MODEL, 0.1, mixed_limits=[([-0.5, -1.0], [1.0], -0.6, 0.4)], **ONE_INPUT, **QUIET),
    "coupled": linear_plant(mixed_limits=[([0.0, 0.0], [-0.5, 1.0], -1.0, 0.2)], **TWO_INPUTS),
}
PLANTS = ASYMMETRIC | MIXED


def certificate(name: str) -> Certificate:
    return certificate_of(PLANTS[name], CONTRACT, "polytope")


def mixed_values(plant: LinearPlant, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """How far limits of states and inputs together are passed, by the plant's rows alone: shape (count, q)."""
    values = np.hstack([states, inputs]) @ plant.mixed_rows.T
    low, high = plant.mixed_ends
    return np.maximum(low - values, values - high)
