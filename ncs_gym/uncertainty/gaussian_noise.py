"""Noise without a bound: which plants it makes sense for, and how likely it is to leave the bounds of a certificate."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from scipy.stats import chi2

from ncs_gym.network.channel import Channel
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.truncated_gaussian import TruncatedGaussian
from ncs_gym.validation import as_count, shown

# How the noise of a plant may be drawn: inside the bounds that its covariances are truncated at, or without a bound.
NOISES = ("truncated", "gaussian")
# Relative error that a chi-square tail probability computed in float64 does not exceed.
TAIL_ROUNDING = 1e-10


def as_noise(value: Any, plant: LinearPlant) -> str:
    """Returns "truncated" or "gaussian", checked.

    "gaussian" draws what a covariance describes, which is process noise, sensor noise and first error, from the
    Gaussian itself. What is bounded by declaration (`gamma`, `disturbance_bound`, `sensor_bound`, `initial_bound`) has
    no distribution beyond its bound and stays inside.

    Raises:
        ValueError: If it is another value, or "gaussian" for a plant without any covariance.
    """
    if not (isinstance(value, str) and value in NOISES):
        raise ValueError(f"noise must be one of {list(NOISES)}, got {shown(value)}")
    if value == "gaussian" and not any(np.any(each.covariance) for each in _noises(plant)):
        raise ValueError(
            'noise="gaussian" needs a covariance of process noise, sensor noise or first error: this plant declares '
            "bounds only, beyond which nothing says how likely anything is"
        )
    return value


def escape_probability(plant: LinearPlant, channel: Channel, steps: int) -> float:
    """Returns a bound on the probability that Gaussian noise leaves a bound of the certificate within some steps.

    T delta_w + N delta_v + delta_0 (theory.md section 9), the union bound over every draw of process noise, of sensor
    noise, of which N = floor(T / M) samples with transmission period M have one, and of the first error; a covariance
    that is zero counts nothing. With `noise="gaussian"` a shield whose certificate verifies keeps x_k in S for all
    k <= T with at least the remaining probability (docs/shield.md, "Gaussian noise").

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
    draws = (count, count // channel.send_period, 1)
    exact = sum(
        (number * _escape(noise, plant.delta) for number, noise in zip(draws, _noises(plant), strict=True)), Fraction(0)
    )
    bound = float(min(exact, Fraction(1)))
    return bound if bound >= min(exact, 1) else float(np.nextafter(bound, np.inf))


def _noises(plant: LinearPlant) -> tuple[TruncatedGaussian, TruncatedGaussian, TruncatedGaussian]:
    """Returns process noise, sensor noise and first error."""
    return plant.process_noise, plant.sensor_noise, plant.initial_noise


def _escape(noise: TruncatedGaussian, delta: float) -> Fraction:
    """Returns a bound on the probability that an untruncated draw lies outside the ellipsoid of a truncated one.

    It is delta, unless rounding 1 - delta made the ellipsoid a little smaller (which shows for the smallest delta). A
    singular covariance has fewer degrees of freedom, and leaves less often.
    """
    if not np.any(noise.covariance):
        return Fraction(0)
    tail = float(chi2.sf(noise.energy, len(noise.covariance)))
    return max(Fraction(delta), Fraction(tail) * (1 + Fraction(TAIL_ROUNDING)) if tail > delta else Fraction(0))
