"""How far OP is from a solution, and how small the uncertainty would have to be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ncs_gym import LinearPlant
from shields.paper.bounds import PaperBounds, PaperModel
from shields.paper.conditions import SMALLEST_GAP
from shields.paper.optimization_problem import MarginProgram

# The domain {0 < kappa < 1, 1 <= rho < 1 / kappa} is scanned with this many points each way, denser near rho = 1.
KAPPAS = np.linspace(0.01, 0.995, 120)
RHO_SHARES = np.linspace(0.0, 1.0, 40) ** 2
# Halvings of the interval in which a largest tolerated bound is sought.
BISECTIONS = 50
# What is reported as feasible was confirmed after shrinking by this, at most this often.
SHRINK, ATTEMPTS = 0.99, 20
# Points of the scan that are tried with the communication error in the input limit.
CONFIRMED_POINTS = 100


@dataclass(frozen=True)
class Feasibility:
    """What the scan of the domain found.

    Attributes:
        ratio: Largest lambda_min(L) / alpha over the domain, L meeting (C1), (C3), (C7) and K_i L K_i' <= u_max^2 / 2;
            OP needs at least 1.
        kappa, rho: Where.
        margin: lambda_min(L) there.
        alpha: alpha there.
    """

    ratio: float
    kappa: float
    rho: float
    margin: float
    alpha: float


class FeasibilityScan:
    """The margins of a plant over the domain, which depend on A, B, C and u_max only: one scan serves all bounds.

    Args:
        plant: The plant; its bounds are not used.
    """

    def __init__(self, plant: LinearPlant) -> None:
        program = MarginProgram(plant, with_error=False)
        self._points: list[tuple[float, float, float]] = []
        for kappa in KAPPAS:
            for share in RHO_SHARES:
                rho = 1.0 + (1.0 / kappa - 1.0) * share
                if kappa * rho > 1.0 - SMALLEST_GAP:
                    continue
                margin = program.largest(PaperBounds(float(kappa), float(rho), np.nan, np.nan, np.nan))
                if margin > 0.0:
                    self._points.append((float(kappa), float(rho), margin))

    def best(self, plant: LinearPlant, model: PaperModel | None = None) -> Feasibility:
        """Returns the best point for a plant with the scanned dynamics and bounds of its own.

        Args:
            plant: Its bounds count.
            model: Of the bounds; that of the plant by default.

        Raises:
            LookupError: If no gain contracts any ellipsoid at any point: (C1) alone has no solution.
        """
        return self._ranked(plant, model)[0]

    def full_ratio(self, plant: LinearPlant) -> float:
        """Returns the largest lambda_min(L)/alpha on all of OP over the most promising points; at least 1: feasible."""
        program, model, best = MarginProgram(plant), PaperModel(plant), 0.0
        for point in self._ranked(plant)[:CONFIRMED_POINTS]:
            bounds = model.at(point.kappa, point.rho)
            best = max(best, program.largest(bounds) / bounds.alpha if bounds.alpha > 0.0 else np.inf)
            if best >= 1.0:
                break
        return best

    def _ranked(self, plant: LinearPlant, model: PaperModel | None = None) -> list[Feasibility]:
        """Returns all points of the scan, the best first."""
        found, model = [], model or PaperModel(plant)
        for kappa, rho, margin in self._points:
            alpha = model.at(kappa, rho).alpha
            ratio = margin / alpha if alpha > 0.0 else np.inf
            found.append(Feasibility(ratio, kappa, rho, margin, alpha))
        if not found:
            raise LookupError("(C1) has no solution at any (kappa, rho)")
        return sorted(found, key=lambda point: -point.ratio)

    def largest(self, plant_at: Callable[[float], LinearPlant], high: float) -> float:
        """Returns the largest t in [0, high] with OP feasible for plant_at(t), confirmed on all of OP; 0.0 if none is.

        Args:
            plant_at: Returns the plant whose bounds grow with t.
            high: Where OP is not feasible.
        """
        low = 0.0
        if self.best(plant_at(0.0)).ratio < 1.0:
            return 0.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.best(plant_at(middle)).ratio >= 1.0 else (low, middle)
        for _ in range(ATTEMPTS):
            if self.full_ratio(plant_at(low)) >= 1.0:
                return low
            low *= SHRINK
        return 0.0


def largest_gamma(scan: FeasibilityScan, plant: LinearPlant) -> float:
    """Returns the largest gamma, everything else as it is, for which OP is feasible; 0.0 if it is at none."""
    return scan.largest(lambda gamma: replace(plant, gamma=gamma), max(plant.gamma, 1e-12))


def largest_scale(scan: FeasibilityScan, plant: LinearPlant) -> float:
    """Returns the largest common factor on gamma, Q and P0 for which OP is feasible."""

    def scaled(factor: float) -> LinearPlant:
        return replace(
            plant,
            gamma=factor * plant.gamma,
            process_noise_cov=factor * plant.process_noise_cov,
            initial_cov=factor * plant.initial_cov,
        )

    return scan.largest(scaled, 1.0)


def largest_noise_scale(scan: FeasibilityScan, plant: LinearPlant) -> float:
    """Returns the largest factor on Q, gamma as it is, for which OP is feasible; 0.0 if it is at none."""
    return scan.largest(lambda factor: replace(plant, process_noise_cov=factor * plant.process_noise_cov), 1.0)
