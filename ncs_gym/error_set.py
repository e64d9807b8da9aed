"""The certified error set: an ellipsoid the estimation error never leaves, whatever the channel does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import minimize_scalar

from ncs_gym.frozen import FrozenArrays
from ncs_gym.plant import LinearPlant

# Growth c of the optimal set: gives (E1) slack that an exact check can see, and updates room (theory.md section 3).
GROWTH = 1.1
# Flat disturbances are thickened by this share of their mean extent, so that (E1) has slack in every direction.
THICKENING = 1e-9
# No set is thinner than this, in half-widths of the safe box (a perfectly known plant has no error at all).
THINNEST = 1e-6


class UnstablePlantError(ValueError):
    """Without a promise from the channel no error bound exists for a plant that is not Schur stable."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ErrorSet(FrozenArrays):
    """E(Sigma) with its rate: (E0) Sigma >= r0^2 I and (E1) Sigma >= A Sigma A'/rate + D/(1 - rate).

    Attributes:
        Sigma: Shape (n, n) [squares of the units of the state].
        rate: lam_e in (0, 1).
    """

    Sigma: np.ndarray
    rate: float

    def __post_init__(self) -> None:
        self._freeze_arrays()


def certified_error_set(plant: LinearPlant) -> ErrorSet:
    """Returns the error set of a stable plant in closed form (theory.md section 3, (E0) and (E1)).

    For a fixed rate the smallest solution of (E1) is a Lyapunov series; where it does not cover the first
    estimate, the missing part is added as a source to the same series. The rate minimizes tr(W Sigma), W the
    weight of the safe box. Multiplying by c = 1.1 keeps both conditions and gives them slack.

    Proof of the bound: e_0 lies in E(r0^2 I). The error obeys e+ = A e - d, so with e in E(Sigma) its support
    is at most that of A Sigma A'/rate + D/(1 - rate), which is inside E(Sigma) by (E1); by induction e_k lies
    in E(Sigma) for all k with no packet at all.

    Raises:
        UnstablePlantError: If the spectral radius of A is 1 or more.
    """
    radius = plant.spectral_radius
    if not radius < 1.0:
        raise UnstablePlantError(
            f"no error bound exists without packets: the spectral radius of A is {radius:.6g}, it must be < 1"
        )
    # In coordinates z = T^-1 x, with W = (T T')^-1, the weight is the identity and units do not matter.
    T = np.linalg.cholesky(np.linalg.inv(plant.weight))
    inverse, identity = np.linalg.inv(T), np.eye(plant.n)
    A = inverse @ plant.A @ T
    D = inverse @ plant.disturbance.shape @ inverse.T
    D = D + THICKENING * float(np.trace(D)) / plant.n * identity
    first = inverse @ plant.initial_error.shape @ inverse.T + THINNEST**2 * identity

    def size(rate: float) -> float:
        return float(np.trace(_smallest_solution(A, D, first, rate)))

    slowest = max(radius**2, 1e-6)
    margin = 1e-4 * (1.0 - slowest)
    best = minimize_scalar(size, bounds=(slowest + margin, 1.0 - margin), method="bounded", options={"xatol": margin})
    Sigma = T @ (GROWTH * _smallest_solution(A, D, first, float(best.x))) @ T.T
    return ErrorSet(Sigma=0.5 * (Sigma + Sigma.T), rate=float(best.x))


def _smallest_solution(A: np.ndarray, D: np.ndarray, first: np.ndarray, rate: float) -> np.ndarray:
    """Returns the Lyapunov solution of (E1) for one rate, enlarged until it covers `first`, shape (n, n)."""
    scaled = A / np.sqrt(rate)
    solution = solve_discrete_lyapunov(scaled, D / (1.0 - rate))
    values, vectors = np.linalg.eigh(first - solution)
    if values[-1] > 0.0:
        missing = (vectors * np.maximum(values, 0.0)) @ vectors.T
        solution = solution + solve_discrete_lyapunov(scaled, missing)
    return 0.5 * (solution + solution.T)
