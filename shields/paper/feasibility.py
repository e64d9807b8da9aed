"""How far OP is from feasible over all (kappa, rho), and how large an uncertainty would be feasible."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym import LinearPlant
from shields.paper.bounds import SMALLEST_GAP, PaperBounds, PaperModel, with_noise
from shields.paper.optimization_problem import OptimizationProblem

# The domain {0 < kappa < 1, 1 <= rho < 1 / kappa} is scanned at these kappa and these fractions of the way from 1 to
# 1 / kappa, which are denser near rho = 1.
_KAPPAS = np.linspace(0.01, 0.995, 120)
_RHO_FRACTIONS = np.linspace(0.0, 1.0, 40) ** 2
# So many points in a row without a solution end the scan of a kappa; one would do if the solver were exact.
_POINTS_WITHOUT_SOLUTION = 3
# Halvings of the interval in which a largest feasible bound is sought.
_BISECTIONS = 50
# A bound found is reduced by this factor, at most this often, until all of OP is confirmed to be feasible.
_REDUCTION, _ATTEMPTS = 0.99, 20
# Points of the scan that are tried with the communication error in the input limit.
_CONFIRMED_POINTS = 100


class Feasibility(NamedTuple):
    """Largest lambda_min(L) / alpha at (kappa, rho), without the communication error in the input limit; OP needs 1."""

    ratio: float
    kappa: float
    rho: float


class FeasibilityScan:
    """The largest lambda_min(L) over the domain, which depends on A, B, C and u_max only: one scan serves all bounds.

    Args:
        plant: The plant; its uncertainty is not used.
    """

    def __init__(self, plant: LinearPlant) -> None:
        self._problem = OptimizationProblem(plant)
        self._points = _scanned(self._problem)

    def best(self, plant: LinearPlant, model: PaperModel | None = None) -> Feasibility:
        """Returns the point of largest ratio for the bounds of a plant, or for other constants of OP."""
        return self._ranked(model or PaperModel(plant))[0]

    def full_ratio(self, plant: LinearPlant, model: PaperModel | None = None) -> float:
        """Returns the largest lambda_min(L)/alpha on all of OP over the most promising points; at least 1: feasible."""
        model, best = model or PaperModel(plant), 0.0
        for point in self._ranked(model)[:_CONFIRMED_POINTS]:
            bounds = model.at(point.kappa, point.rho)
            best = max(best, self._problem.largest_eigenvalue(bounds) / bounds.alpha if bounds.alpha > 0.0 else np.inf)
            if best >= 1.0:
                break
        return best

    def _ranked(self, model: PaperModel) -> list[Feasibility]:
        points = []
        for kappa, rho, eigenvalue in self._points:
            alpha = model.at(kappa, rho).alpha
            points.append(Feasibility(eigenvalue / alpha if alpha > 0.0 else np.inf, kappa, rho))
        return sorted(points, key=lambda point: -point.ratio)


def _scanned(problem: OptimizationProblem) -> tuple[tuple[float, float, float], ...]:
    """Returns the points (kappa, rho) at which (C1) has a solution, each with its largest lambda_min(L).

    A smaller rho only restricts L further, so the scan of a kappa goes down from its largest rho until there is none.
    """
    points = []
    for kappa in _KAPPAS.tolist():
        without = 0
        for fraction in _RHO_FRACTIONS[::-1].tolist():
            rho = 1.0 + (1.0 / kappa - 1.0) * fraction
            if kappa * rho > 1.0 - SMALLEST_GAP:
                continue
            bounds = PaperBounds(kappa, rho, np.nan, np.nan, np.nan)
            eigenvalue = problem.largest_eigenvalue(bounds, with_error=False)
            if eigenvalue > 0.0:
                points.append((kappa, rho, eigenvalue))
                without = 0
            else:
                without += 1
            if without == _POINTS_WITHOUT_SOLUTION:
                break
    return tuple(sorted(points))


def largest_scale(scan: FeasibilityScan, plant: LinearPlant) -> float:
    """Returns the largest common factor on gamma, Q and P0, below 1, with which OP is feasible; 0.0 if none is."""
    gamma, Q, P0 = plant.gamma, plant.process_noise.covariance, plant.initial_noise.covariance

    def scaled(by: float) -> LinearPlant:
        return with_noise(plant, gamma=by * gamma, Q=by * Q, P0=by * P0)

    low, high = 0.0, 1.0
    if scan.best(scaled(low)).ratio < 1.0:
        return 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if scan.best(scaled(middle)).ratio >= 1.0 else (low, middle)
    for _ in range(_ATTEMPTS):
        if scan.full_ratio(scaled(low)) >= 1.0:
            return low
        low *= _REDUCTION
    return 0.0
