"""How likely Gaussian noise is to leave the bounds that certificates are made from."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from ncs_gym.network.channel import Channel
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import as_count, shown


def bound_violation_probability(plant: LinearPlant, channel: Channel, steps: int) -> float:
    """Returns a bound on the probability that Gaussian noise leaves a bound of the certificate within some steps.

    T delta_w + N delta_v + delta_0 (docs/shield.md, "Gaussian noise"), the union bound over every draw of process
    noise, of sensor noise, of which N = floor(T / M) samples with transmission period M have one, and of the first
    error; a covariance that is zero counts nothing. With `noise="gaussian"` a shield whose certificate verifies keeps
    x_k in S for all k <= T with at least the remaining probability.

    Args:
        plant: The plant, whose `delta` is the probability that a draw leaves its ellipsoid.
        channel: Gives the transmission period.
        steps: T.

    Returns:
        At most 1, and no smaller than the exact sum.

    Raises:
        ValueError: If an argument is of the wrong kind or `steps` is negative.
    """
    if not isinstance(plant, LinearPlant) or not isinstance(channel, Channel):
        raise ValueError(f"expected a LinearPlant and a Channel, got {shown(plant)} and {shown(channel)}")
    count = as_count(steps, "steps", low=0)
    noises = plant.process_noise, plant.sensor_noise, plant.initial_noise
    draws = count, count // channel.send_period, 1
    # Each truncation cuts off at most delta (`truncation_energy`); a covariance of fewer dimensions leaves less often.
    drawn = sum(number for noise, number in zip(noises, draws, strict=True) if np.any(noise.covariance))
    exact = drawn * Fraction(plant.delta)
    bound = float(min(exact, Fraction(1)))
    return bound if bound >= min(exact, 1) else float(np.nextafter(bound, np.inf))
