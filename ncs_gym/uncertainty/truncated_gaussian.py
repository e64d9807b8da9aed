"""Gaussian noise whose energy is truncated, so that a hard bound holds next to the covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.special import chdtr, chdtri, gammaincinv

from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import ReadOnlyArrays

# A truncation that keeps less than this probability would make rejection sampling crawl.
SMALLEST_KEPT = 1e-3


@dataclass(frozen=True, eq=False)
class TruncatedGaussian(ReadOnlyArrays):
    """w ~ N(0, covariance) conditioned on w' covariance^-1 w <= energy.

    Attributes:
        covariance: Shape (n, n), of the Gaussian before truncation.
        energy: The largest squared Mahalanobis norm that is kept, a chi-square quantile.
    """

    covariance: np.ndarray
    energy: float

    def __post_init__(self) -> None:
        self._make_arrays_read_only()

    @cached_property
    def bound(self) -> Ellipsoid:
        """The ellipsoid that holds every sample: shape energy * covariance."""
        return Ellipsoid(self.energy * self.covariance)

    @cached_property
    def factor(self) -> np.ndarray | None:
        """G with G G' = covariance; None when there is no noise (then no random number is drawn)."""
        return Ellipsoid(self.covariance).factor if np.any(self.covariance) else None

    def sample(self, rng: np.random.Generator, count: int | None = None, *, truncated: bool = True) -> np.ndarray:
        """Returns one draw, shape (n,), or `count` of them, shape (count, n), by rejection.

        Args:
            rng: Source of randomness.
            count: Number of draws; None for a single one.
            truncated: False draws from the Gaussian itself, which has no bound.
        """
        size = 1 if count is None else count
        if self.factor is None:
            points = np.zeros((size, self.covariance.shape[0]))
        else:
            points = (self.factor @ self._normals(rng, size, self.energy if truncated else np.inf)).T
        return points[0] if count is None else points

    def _normals(self, rng: np.random.Generator, count: int, energy: float) -> np.ndarray:
        """Returns standard normal columns, shape (n, count), each with a sum of squares of at most `energy`."""
        normals = rng.standard_normal((self.covariance.shape[0], count))
        rejected = np.flatnonzero(~(np.square(normals).sum(axis=0) <= energy))
        while rejected.size:
            again = rng.standard_normal((len(normals), rejected.size))
            normals[:, rejected] = again
            rejected = rejected[~(np.square(again).sum(axis=0) <= energy)]
        return normals


@cache
def chi2_quantile(probability: float, degrees: int) -> float:
    """Returns the chi-square quantile chi2_{degrees, probability}, rounded up.

    Liu et al. Theorem 2 needs the 1 - delta quantile, so `probability` is 1 - delta. That float lies up to 2^-54 from
    the number; where delta is small this counts, and the quantile is one for delta less that much. The functions of
    scipy.special are those behind scipy.stats.chi2, which takes long to import.

    Args:
        probability: In [0.001, 1).
        degrees: Degrees of freedom, >= 1.
    """
    certainly_removed = (1.0 - probability) - 2.0**-54
    quantile = 2.0 * float(gammaincinv(0.5 * degrees, probability)) * (1.0 + 1e-12)
    quantile = max(quantile, float(chdtri(degrees, certainly_removed)) * (1.0 + 1e-13))
    while chdtr(degrees, quantile) < probability:
        quantile = float(np.nextafter(quantile, np.inf))
    return quantile
