"""Gaussian noise whose energy is truncated, so that a hard bound holds next to the covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from flint import arb, ctx, fmpq

from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import ReadOnlyArrays

# A truncation that keeps less than this probability would make rejection sampling crawl.
SMALLEST_KEPT = 1e-3
# Smaller truncation levels are not offered: no datasheet knows them.
SMALLEST_DELTA = 1e-12
# Bits of ball arithmetic that tell nearly always on which side of a probability a tail lies.
PRECISION = 128


@dataclass(frozen=True, eq=False)
class TruncatedGaussian(ReadOnlyArrays):
    """w ~ N(0, covariance), shape (n, n), conditioned on w' covariance^-1 w <= energy.

    Attributes:
        covariance, energy: The same.
        known: How many of the last entries are known, and zero.
    """

    covariance: np.ndarray
    energy: float
    known: int = 0

    def __post_init__(self) -> None:
        self._make_arrays_read_only()

    @cached_property
    def bound(self) -> Ellipsoid:
        """The ellipsoid that holds every truncated sample."""
        return Ellipsoid(self.energy * self.covariance)

    @cached_property
    def factor(self) -> np.ndarray | None:
        """G with G G' = covariance, a column per unknown entry; None without noise, for which no number is drawn."""
        unknown = len(self.covariance) - self.known
        factor = Ellipsoid(self.covariance[:unknown, :unknown]).factor if np.any(self.covariance) else None
        return None if factor is None else np.pad(factor, ((0, self.known), (0, 0)))

    def sample(self, rng: np.random.Generator, count: int | None = None, *, truncated: bool = True) -> np.ndarray:
        """Returns one draw, shape (n,), or `count` of them, (count, n), of the truncated Gaussian or of itself."""
        size = 1 if count is None else count
        if self.factor is None:
            points = np.zeros((size, self.covariance.shape[0]))
        else:
            points = (self.factor @ self._normals(rng, size, self.energy if truncated else np.inf)).T
        return points[0] if count is None else points

    def _normals(self, rng: np.random.Generator, count: int, energy: float) -> np.ndarray:
        """Returns standard normal columns, shape (n, count), each with a sum of squares of at most `energy`."""
        normals = rng.standard_normal((len(self.covariance) - self.known, count))
        rejected = np.flatnonzero(~(np.square(normals).sum(axis=0) <= energy))
        while rejected.size:
            again = rng.standard_normal((len(normals), rejected.size))
            normals[:, rejected] = again
            rejected = rejected[~(np.square(again).sum(axis=0) <= energy)]
        return normals


@cache
def truncation_energy(delta: float, degrees: int) -> float:
    """Returns chi2_{degrees, 1 - delta}, rounded up: the smallest float64 exceeded with at most probability delta."""
    low, high = 0.0, 1.0
    while _cuts_off_more(high, delta, degrees):
        low, high = high, 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if _cuts_off_more(middle, delta, degrees) else (low, middle)
    return high


def _cuts_off_more(energy: float, delta: float, degrees: int) -> bool:
    precision = PRECISION
    while True:
        with ctx.workprec(precision):
            beyond = arb(energy / 2.0).gamma_upper(arb(fmpq(degrees, 2)), regularized=1)
            if beyond > arb(delta) or beyond <= arb(delta):
                return bool(beyond > arb(delta))
        precision *= 2
