"""An exothermic stirred-tank reactor, linearized at its unstable operating point."""

from __future__ import annotations

import numpy as np

from ncs_gym.bounds import Ball, Bounds, Through
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.linear_plant import LinearPlant


def stirred_tank(dt: float = 3.0) -> LinearPlant:
    """Returns the continuous stirred-tank reactor of Seborg et al. at its unstable point, by exact zero-order hold.

    x = (concentration [cmol/L], temperature [K]) and u the temperature of the coolant [K], |u| <= 20, all in
    deviations from the operating point. An exothermic reaction heats what it is sped up by: left alone, deviations grow
    by a factor of 2.7 in 21 s (a pole at +2.83/min). Safe box 10 and 5 K. What comes in is up to 2 K/min too warm or
    too cold; both states are measured to within 0.02 of their units.

    Seborg et al. 2016 (docs/bibliography.md), the reactor of chapter 2.

    Args:
        dt: Step [s].
    """
    # Given per minute.
    reaction = np.array([[-2.0, -3.57], [2.092, 4.38]]) / 60.0
    coolant, feed = np.array([[0.0], [2.092]]) / 60.0, np.array([[0.0], [1.0]]) / 60.0
    model = Model.sampled(reaction, coolant, None, dt)
    return LinearPlant(
        model,
        Limits(state=[10.0, 5.0], input=20.0),
        Bounds(disturbance=Through(model.held(feed), 2.0), sensor=Ball(0.02), first_error=Ball(0.1)),
        {"states": {"concentration": "cmol/L", "temperature": "K"}, "inputs": {"coolant temperature": "K"}},
    )
