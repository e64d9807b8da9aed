"""Distributions of noise and disturbances as compiled loops draw them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.compiled import inner
from ncs_gym.draws import fill_directions, fill_truncated, fill_uniform, normals
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.product import add_product
from ncs_gym.uncertainty.disturbance import ROUNDING, BallDisturbance, BoxDisturbance, Disturbance, SphereDisturbance
from ncs_gym.uncertainty.truncated_gaussian import TruncatedGaussian

# What h in F h is: nothing, uniform in a box, truncated normal, uniform in a ball, uniform on a sphere.
NOTHING, BOX, NORMAL, BALL, SPHERE = range(5)


class Law(NamedTuple):
    """The distribution of F h.

    Attributes:
        kind: Of h, whose size is 1.
        factor: F, shape (n, n), diagonal for a box.
        energy: The largest h'h of a truncated normal h.
    """

    kind: int
    factor: np.ndarray
    energy: float = 0.0


def law_of_noise(noise: TruncatedGaussian) -> Law:
    """Returns the law of a truncated Gaussian."""
    factor = noise.factor
    if factor is None:
        return Law(NOTHING, np.zeros_like(noise.covariance))
    return Law(NORMAL, factor, noise.energy)


def law_of_disturbance(source: Disturbance, plant: LinearPlant) -> Law | None:
    """Returns the law of a disturbance that depends on nothing; None of any other, and of what a user wrote."""
    n, kind = plant.n, type(source)
    if isinstance(source, BoxDisturbance) and kind is BoxDisturbance:
        return Law(BOX, np.diag(source.widths(plant)))
    if kind is BallDisturbance:
        return Law(BALL, np.sqrt(plant.gamma) * np.eye(n))
    if kind is SphereDisturbance:
        return Law(SPHERE, (1.0 - ROUNDING) * plant.nominal_disturbance.factor)
    return None


@inner
def add_drawn(kind, factor, energy, keys, number, out):
    """Adds a draw F h of a law, numbers from `number` on, to each column of `out`, shape (n, N)."""
    if kind == NOTHING:
        return
    n = out.shape[0]
    # The first n coordinates of a direction in n + 2 dimensions are uniform in the ball (Archimedes for n = 1).
    rank = n + 2 if kind == BALL else n
    h = normals(rank, out.shape[1])
    if kind == BOX:
        fill_uniform(keys, number, n, h)
        for i in range(n):
            width = factor[i, i]
            for e in range(out.shape[1]):
                out[i, e] += width * (2.0 * h[i, e] - 1.0)
        return
    if kind == NORMAL:
        fill_truncated(keys, number, energy, rank, h)
    else:
        fill_directions(keys, number, rank, h)
    add_product(factor, h, out)
