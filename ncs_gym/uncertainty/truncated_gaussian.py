"""Gaussian noise whose energy is truncated, so that a hard bound holds next to the covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.stats import chi2

from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import FrozenArrays

# A truncation that keeps less than this probability would make rejection sampling crawl.
SMALLEST_KEPT = 1e-3


@dataclass(frozen=True, eq=False)
class TruncatedGaussian(FrozenArrays):
    """w ~ N(0, covariance) conditioned on w' covariance^-1 w <= energy.

    Attributes:
        covariance: Shape (n, n), of the Gaussian before truncation.
        energy: The largest squared Mahalanobis norm that is kept, a chi-square quantile.
    """

    covariance: np.ndarray
    energy: float

    def __post_init__(self) -> None:
        self._freeze_arrays()

    @cached_property
    def bound(self) -> Ellipsoid:
        """The ellipsoid that holds every sample: shape energy * covariance."""
        return Ellipsoid(self.energy * self.covariance)

    @cached_property
    def factor(self) -> np.ndarray | None:
        """G with G G' = covariance; None when there is no noise (then no random number is drawn)."""
        return Ellipsoid(self.covariance).factor if np.any(self.covariance) else None

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Returns one draw, shape (n,), by rejection."""
        factor = self.factor
        if factor is None:
            return np.zeros(self.covariance.shape[0])
        while True:
            direction = rng.standard_normal(factor.shape[0])
            if direction @ direction <= self.energy:
                return factor @ direction

    def sample_many(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Returns draws, shape (count, n), by compiled loops."""
        from ncs_gym.draws import fill_truncated, normals

        if self.factor is None:
            return np.zeros((count, self.covariance.shape[0]))
        rank = self.factor.shape[1]
        keys, drawn = rng.integers(2**64, size=count, dtype=np.uint64), normals(rank, count)
        fill_truncated(keys, 0, self.energy, rank, drawn)
        return (self.factor @ drawn[:rank]).T


@cache
def chi2_quantile(probability: float, degrees: int) -> float:
    """Returns the chi-square quantile chi2_{degrees, probability}, rounded up.

    Liu et al. Theorem 5 needs the 1 - delta quantile, so `probability` is 1 - delta.

    Args:
        probability: In [0.001, 1).
        degrees: Degrees of freedom, >= 1.
    """
    quantile = float(chi2.ppf(probability, degrees)) * (1.0 + 1e-12)
    while chi2.cdf(quantile, degrees) < probability:
        quantile = float(np.nextafter(quantile, np.inf))
    return quantile
