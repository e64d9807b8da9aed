"""The unstable batch reactor of the networked-control literature."""

from __future__ import annotations

import numpy as np

from ncs_gym.bounds import noise_in_proportion
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.linear_plant import LinearPlant

# Bounds on disturbance and sensor noise as fractions of the half-widths of the box.
DISTURBANCE_FRACTION = 5e-3
SENSOR_FRACTION = 1e-3


def batch_reactor(dt: float = 0.05) -> LinearPlant:
    """Returns the unstable batch reactor of the networked-control literature, by exact zero-order hold.

    Four states, two inputs, two outputs (x1 + x3 - x4 and x2), dimensionless; safe box |x_i| <= 1, |u_i| <= 2.

    Args:
        dt: Step [s].
    """
    A = np.array(
        [
            [1.38, -0.2077, 6.715, -5.676],
            [-0.5814, -4.29, 0.0, 0.675],
            [1.067, 4.273, -6.654, 5.893],
            [0.048, 4.273, 1.343, -2.104],
        ]
    )
    B = np.array([[0.0, 0.0], [5.679, 0.0], [1.136, -3.146], [1.136, 0.0]])
    H = np.array([[1.0, 0.0, 1.0, -1.0], [0.0, 1.0, 0.0, 0.0]])
    half_widths = np.ones(4)
    noise = noise_in_proportion(half_widths, H, DISTURBANCE_FRACTION, SENSOR_FRACTION)
    return LinearPlant(Model.sampled(A, B, H, dt), Limits(state=half_widths, input=2.0), noise)
