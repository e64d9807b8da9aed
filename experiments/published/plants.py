"""The published plants, as arguments of `LinearPlant`, and the network that each is put behind."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from ncs_gym import Channel, ChannelContract, LinearPlant
from ncs_gym.plants.statespace import zero_order_hold


@cache
def published() -> dict[str, dict[str, Any]]:
    """Returns what was published of each plant by its name: source, model, limits, disturbance, sensors and network."""
    return json.loads(files("experiments.published").joinpath("plants.json").read_text(encoding="utf-8"))


def plant_of(name: str) -> LinearPlant:
    """Returns a published plant with its limits as they are.

    Disturbances of a model in continuous time are constant over a step. Where no state has a published limit, all have
    those that the file invents.
    """
    p = published()[name]
    A, n, dt = np.array(p["A"]), len(p["A"]), p["dt"]
    state = np.zeros(n) if p["operating_state"] is None else np.array(p["operating_state"])
    low, high = _ends(p["state_low"], -np.inf), _ends(p["state_high"], np.inf)
    if not (np.isfinite(low) | np.isfinite(high)).any():
        widths = np.array([p["invented_half_widths"].get(str(i), np.inf) for i in range(n)])
        low, high = state - widths, state + widths
    is_continuous = p["time"] == "continuous"
    E = np.array(p["disturbance_matrix"])
    E = zero_order_hold(A, E, dt)[1] if is_continuous else E
    outputs = [
        (each["row"], *(end + np.dot(each["row"], state) for end in (_end(each["low"], -1.0), _end(each["high"], 1.0))))
        for each in p["output_rows"]
    ]
    return LinearPlant.from_statespace(
        (A, p["B"], p["C"], 0) if is_continuous else (A, p["B"], p["C"], 0, dt),
        dt,
        operating_state=state,
        operating_input=p["operating_input"],
        state_limits=(low, high),
        input_limits=(p["input_low"], p["input_high"]),
        output_limits=outputs or None,
        disturbance_bound=(E, p["disturbance_low"], p["disturbance_high"]),
        sensor_bound=p["sensor_half_widths"],
        initial_bound=p["first_error_half_widths"],
    )


def contract_of_plant(name: str) -> ChannelContract:
    """Returns what the network of a published plant promises."""
    return ChannelContract(max_age=published()[name]["max_age"])


def channel_of(name: str) -> Channel:
    """Returns a channel that keeps this contract."""
    return Channel(**published()[name]["channel"])


def _ends(ends: list[float | None], infinity: float) -> np.ndarray:
    return np.array([infinity if end is None else end for end in ends])


def _end(end: float | None, sign: float) -> float:
    return sign * np.inf if end is None else end
