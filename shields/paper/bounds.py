"""The error bounds of Liu et al., exactly as printed (docs/paper.md says what holds of them)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from ncs_gym import Ball, Bounds, Gaussian, LinearPlant

# Where kappa rho is nearer to 1 than this, the error bound is infinite for practical purposes.
SMALLEST_GAP = 1e-9


def uplink_error_bound(p0: float, q_bar: float, quantile: float, g2: float, rest: float) -> float:
    """Returns eps_up = (p0 g2 + q_bar / (1 - g2)) chi2_{n,1-delta} (Liu et al. Theorem 2).

    It holds with probability 1 - delta at each single step; "for all k" does not follow. The term p0 g2 is kept as
    printed, although p0 g2^k is p0 at k = 0.

    Args:
        p0: lambda_max(P0).
        q_bar: lambda_max(Q) + gamma.
        quantile: The chi-square factor.
        g2: g_bar^2.
        rest: 1 - g2 > 0, whose digits are lost if g2 is rounded first.
    """
    return (p0 * g2 + q_bar / rest) * quantile


def state_error_bound(norm: float, g2: float, epsilon_up: float) -> float:
    """Returns eps = (g_bar + |A|_2)^2 eps_up, a bound on e'e, e = B K e_up (Liu et al. Theorem 3), given |A|_2.

    It uses |BK|_2 <= |A + BK|_2 + |A|_2 <= g_bar + |A|_2.
    """
    return (g2**0.5 + norm) ** 2 * epsilon_up


def safety_margin(gamma: float, epsilon: float, kappa: float) -> float:
    """Returns alpha = ((sqrt(gamma) + sqrt(eps)) / (1 - sqrt(kappa)))^2, 0 for kappa = 1 (Liu et al. Definition 4)."""
    if kappa == 1.0:
        return 0.0
    # 1 - sqrt(kappa) = (1 - kappa) / (1 + sqrt(kappa)) keeps its digits near kappa = 1.
    return ((gamma**0.5 + epsilon**0.5) * (1.0 + kappa**0.5) / (1.0 - kappa)) ** 2


@dataclass(frozen=True)
class PaperBounds:
    """The constants of OP at one point (kappa, rho).

    Attributes:
        kappa: Contraction factor, in (0, 1].
        rho: Bound on the condition number of L, in [1, 1 / kappa).
        epsilon_up: Bound of Theorem 2 on the squared uplink error, at g_bar^2 = kappa rho.
        epsilon: Bound of Theorem 3 on the squared state error.
        alpha: Lower bound on lambda_min(L) that (C2) demands.
    """

    kappa: float
    rho: float
    epsilon_up: float
    epsilon: float
    alpha: float


def with_noise(
    plant: LinearPlant,
    *,
    gamma: float | None = None,
    Q: np.ndarray | None = None,
    R: np.ndarray | None = None,
    P0: np.ndarray | None = None,
) -> LinearPlant:
    """Returns a plant with a ball of disturbances and Gaussian noise, as the paper has them, some in place of its own.

    Args:
        plant: The plant, of which nothing else is declared.
        gamma: Squared radius of the ball.
        Q: Covariance of process noise, shape (n, n).
        R: Covariance of sensor noise, shape (p, p).
        P0: Covariance of the first error, shape (n, n).
    """
    own = plant.process_noise.covariance, plant.sensor_noise.covariance, plant.initial_noise.covariance
    given = zip((Q, R, P0), own, strict=True)
    process, sensor, first = (Gaussian(kept if new is None else new, plant.delta) for new, kept in given)
    ball = Ball(np.sqrt(plant.gamma if gamma is None else gamma))
    return replace(plant, bounds=Bounds(disturbance=ball + process, sensor=sensor, first_error=first))


# What the paper's theorems know of limits.
SYMMETRIC = "limits |c_j x| <= 1 at samples and |u_i| <= u_max_i alone"


def unknown_bounds(plant: LinearPlant) -> list[str]:
    """Returns the declared bounds of a plant of which the paper's theorems know nothing, as a user gave them."""
    other = "another set in Bounds({}=...)".format
    declared = {
        other("disturbance"): plant.of_disturbance.bound,
        "a remainder": plant.remainder_bound,
        other("sensor"): plant.of_sensor.bound,
        other("first_error"): plant.of_first_error.bound,
    }
    return [name for name, bound in declared.items() if bound is not None and np.any(bound.shape_matrix)]


class PaperModel:
    """The constants of OP for one plant, as a function of (kappa, rho).

    Args:
        plant: The plant with its bounds.
        quantile: Read in place of the chi-square factor chi2_{n,1-delta}.
    """

    def __init__(self, plant: LinearPlant, *, quantile: float | None = None) -> None:
        self._gamma, self._norm = plant.gamma, float(np.linalg.norm(plant.A, 2))
        self._p0 = _largest(plant.initial_noise.covariance)
        self._q_bar = _largest(plant.process_noise.covariance) + plant.gamma
        self._quantile = plant.process_noise.energy if quantile is None else quantile

    def epsilon_up(self, g2: float, rest: float | None = None) -> float:
        """Returns the bound of Theorem 2 at g_bar^2, and at what it leaves of 1 where that is known more exactly."""
        return uplink_error_bound(self._p0, self._q_bar, self._quantile, g2, 1.0 - g2 if rest is None else rest)

    def at(self, kappa: float, rho: float) -> PaperBounds:
        """Returns the constants of OP with g_bar = sqrt(kappa rho), kappa rho < 1."""
        g2 = kappa * rho
        epsilon_up = self.epsilon_up(g2, float(1 - Fraction(kappa) * Fraction(rho)))
        epsilon = state_error_bound(self._norm, g2, epsilon_up)
        return PaperBounds(kappa, rho, epsilon_up, epsilon, safety_margin(self._gamma, epsilon, kappa))


def _largest(covariance: np.ndarray) -> float:
    return max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0)
