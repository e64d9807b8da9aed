"""How likely Gaussian noise is to leave the bounds that certificates are made from."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from scipy.special import chdtrc

from ncs_gym.network.channel import Channel
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.truncated_gaussian import TruncatedGaussian
from ncs_gym.validation import as_count, shown

# Relative error that a chi-square tail probability computed in float64 does not exceed.
TAIL_ROUNDING = 1e-10


def escape_probability(plant: LinearPlant, channel: Channel, steps: int) -> float:
    """Returns a bound on the probability that Gaussian noise leaves a bound of the certificate within some steps.

    T delta_w + N delta_v + delta_0 (docs/shield_proof.md, "Gaussian noise"), the union bound over every draw of process
    noise, of sensor noise, of which N = floor(T / M) samples with transmission period M have one, and of the first
    error; a covariance that is zero counts nothing. With `noise="gaussian"` a shield whose certificate verifies keeps
    x_k in S for all k <= T with at least the remaining probability.

    Args:
        plant: The plant, whose `delta` is the probability that a draw leaves its ellipsoid.
        channel: Gives the transmission period.
        steps: T, the number of steps.

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
    exact = Fraction(0)
    for noise, number in zip(noises, draws, strict=True):
        exact += number * _escape(noise, plant.delta)
    bound = float(min(exact, Fraction(1)))
    return bound if bound >= min(exact, 1) else float(np.nextafter(bound, np.inf))


def _escape(noise: TruncatedGaussian, delta: float) -> Fraction:
    """Returns a bound on the probability that an untruncated draw lies outside the ellipsoid of a truncated one.

    It is delta, unless rounding 1 - delta made the ellipsoid a little smaller (which shows for the smallest delta). A
    singular covariance has fewer degrees of freedom, and leaves less often.
    """
    if not np.any(noise.covariance):
        return Fraction(0)
    tail = float(chdtrc(len(noise.covariance), noise.energy))
    return max(Fraction(delta), Fraction(tail) * (1 + Fraction(TAIL_ROUNDING)) if tail > delta else Fraction(0))
