"""The error bounds of Liu et al., exactly as printed (docs/paper.md says what holds of them)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from ncs_gym import Ball, Bounds, Gaussian, LinearPlant
from ncs_gym.uncertainty.truncated_gaussian import SMALLEST_DELTA, SMALLEST_KEPT, truncation_energy
from ncs_gym.validation import as_covariance, as_matrix, as_number

# Where kappa rho is nearer to 1 than this, the error bound is infinite for practical purposes.
SMALLEST_GAP = 1e-9


def covariance_bound(k: int, p0: float, g2: float, q_bar: float) -> float:
    """Returns p_bar_k = p0 g2^k + q_bar (1 + g2 + ... + g2^(k-1)) (Liu et al. Theorem 1).

    The covariance P_k of a filter that predicts with G = A + BK obeys P_k <= p_bar_k I if G G' <= g2 I.

    Args:
        k: Step, >= 0.
        p0: lambda_max(P0).
        g2: Square of g_bar, >= 0.
        q_bar: lambda_max(Q) + gamma.

    Raises:
        ValueError: If an argument is out of range.
    """
    if isinstance(k, bool) or not isinstance(k, (int, np.integer)) or k < 0:
        raise ValueError(f"k must be a whole number >= 0, got {k!r}")
    p0, g2, q_bar = (as_number(v, name, low=0.0) for v, name in ((p0, "p0"), (g2, "g2"), (q_bar, "q_bar")))
    try:
        return p0 * g2**k + q_bar * sum(g2**i for i in range(k))
    except OverflowError as error:
        raise ValueError(f"p_bar_k is too large for k = {k} and g2 = {g2:g}") from error


def process_bound(gamma: float, process_noise_cov: np.ndarray) -> float:
    """Returns q_bar = lambda_max(Q) + gamma, the smallest with Q + gamma I <= q_bar I (Liu et al. Definition 1).

    Raises:
        ValueError: If gamma is negative or Q is no covariance.
    """
    gamma = as_number(gamma, "gamma", low=0.0)
    Q = as_covariance(process_noise_cov, len(np.atleast_1d(process_noise_cov)), "process_noise_cov")
    return _largest(Q) + gamma


def uplink_error_bound(
    gamma: float, process_noise_cov: np.ndarray, initial_cov: np.ndarray, delta: float, g2: float
) -> float:
    """Returns eps_up = (p0 g2 + q_bar / (1 - g2)) chi2_{n,1-delta} (Liu et al. Theorem 2).

    It is a quantile per step: if the error is Gaussian, its square stays below the bound with probability 1 - delta at
    each single step; "for all k" does not follow. The term p0 g2 is kept as printed, although p0 g2^k is p0 at k = 0.

    Args:
        gamma: Squared radius of the disturbance, >= 0.
        process_noise_cov: Q, shape (n, n).
        initial_cov: P0, shape (n, n).
        delta: Truncation level, in [1e-12, 0.999].
        g2: g_bar^2 in [0, 1); at 1 the bound is infinite.

    Returns:
        A bound on e_up'e_up [square of the state's unit].

    Raises:
        ValueError: If an argument is out of range or no covariance.
    """
    g2 = as_number(g2, "g2", low=0.0, high=1.0, high_open=True)
    delta = as_number(delta, "delta", low=SMALLEST_DELTA, high=1.0 - SMALLEST_KEPT)
    Q = as_covariance(process_noise_cov, len(np.atleast_1d(process_noise_cov)), "process_noise_cov")
    P0 = as_covariance(initial_cov, len(Q), "initial_cov")
    return _uplink(_largest(P0), process_bound(gamma, Q), truncation_energy(delta, len(Q)), g2, 1.0 - g2)


def state_error_bound(A: np.ndarray, g2: float, epsilon_up: float) -> float:
    """Returns eps = (g_bar + |A|_2)^2 eps_up, a bound on e'e, e = B K e_up (Liu et al. Theorem 3).

    It uses |BK|_2 <= |A + BK|_2 + |A|_2 <= g_bar + |A|_2.

    Raises:
        ValueError: If g2 or eps_up is negative, or A is no finite matrix.
    """
    g2, epsilon_up = as_number(g2, "g2", low=0.0), as_number(epsilon_up, "epsilon_up", low=0.0)
    return _state(float(np.linalg.norm(as_matrix(A, (None, None), "A"), 2)), g2, epsilon_up)


def safety_margin(gamma: float, epsilon: float, kappa: float) -> float:
    """Returns alpha = ((sqrt(gamma) + sqrt(eps)) / (1 - sqrt(kappa)))^2, 0 for kappa = 1 (Liu et al. Definition 4).

    Raises:
        ValueError: If gamma or eps is negative or kappa is outside (0, 1].
    """
    gamma, epsilon = as_number(gamma, "gamma", low=0.0), as_number(epsilon, "epsilon", low=0.0)
    kappa = as_number(kappa, "kappa", low=0.0, high=1.0, low_open=True)
    return _alpha(gamma, epsilon, kappa)


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
    """Returns a plant with a ball of disturbances and Gaussian noise, as the paper has them, some of them others.

    Args:
        plant: The plant, of which nothing else is declared.
        gamma: Squared radius of the ball, in place of its own.
        Q: Covariance of process noise, shape (n, n), alike.
        R: Of sensor noise, shape (p, p), alike.
        P0: Of the first error, shape (n, n), alike.
    """
    own = plant.process_noise_cov, plant.measurement_noise_cov, plant.initial_cov
    given = zip((Q, R, P0), own, strict=True)
    process, sensor, first = (Gaussian(kept if new is None else new, plant.delta) for new, kept in given)
    ball = Ball(np.sqrt(plant.gamma if gamma is None else gamma))
    return replace(plant, bounds=Bounds(disturbance=ball + process, sensor=sensor, first_error=first))


def unknown_bounds(plant: LinearPlant) -> list[str]:
    """Returns the declared bounds of a plant of which the paper's theorems know nothing, as a user gave them."""
    other = "another set in Bounds({}=...)".format
    declared = {
        other("disturbance"): plant.disturbance_bound,
        "a remainder": plant.remainder_bound,
        other("sensor"): plant.sensor_bound,
        other("first_error"): plant.initial_bound,
    }
    return [name for name, bound in declared.items() if bound is not None and np.any(bound.shape_matrix)]


class PaperModel:
    """The constants of OP for one plant, as a function of (kappa, rho).

    Args:
        plant: The plant with its bounds.
        q_bar: Read in place of lambda_max(Q) + gamma.
        quantile: Read in place of the chi-square factor chi2_{n,1-delta}.
    """

    def __init__(self, plant: LinearPlant, *, q_bar: float | None = None, quantile: float | None = None) -> None:
        self._gamma = plant.gamma
        self._p0 = _largest(plant.initial_cov)
        self._q_bar = process_bound(plant.gamma, plant.process_noise_cov) if q_bar is None else q_bar
        self._quantile = plant.process_noise.energy if quantile is None else quantile
        self._norm = float(np.linalg.norm(plant.A, 2))

    def at(self, kappa: float, rho: float) -> PaperBounds:
        """Returns the constants of OP with g_bar = sqrt(kappa rho), kappa rho < 1."""
        g2 = kappa * rho
        rest = float(1 - Fraction(kappa) * Fraction(rho))
        epsilon_up = _uplink(self._p0, self._q_bar, self._quantile, g2, rest)
        epsilon = _state(self._norm, g2, epsilon_up)
        return PaperBounds(kappa, rho, epsilon_up, epsilon, _alpha(self._gamma, epsilon, kappa))


def _largest(covariance: np.ndarray) -> float:
    return max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0)


def _uplink(p0: float, q_bar: float, quantile: float, g2: float, rest: float) -> float:
    """Returns the bound of Theorem 2 from g2 and rest = 1 - g2, whose digits are lost if g2 is rounded first."""
    return (p0 * g2 + q_bar / rest) * quantile


def _state(norm: float, g2: float, epsilon_up: float) -> float:
    return (g2**0.5 + norm) ** 2 * epsilon_up


def _alpha(gamma: float, epsilon: float, kappa: float) -> float:
    if kappa == 1.0:
        return 0.0
    # 1 - sqrt(kappa) = (1 - kappa) / (1 + sqrt(kappa)) keeps its digits near kappa = 1.
    return ((gamma**0.5 + epsilon**0.5) * (1.0 + kappa**0.5) / (1.0 - kappa)) ** 2
