"""The search for a certified plan whose first input is close to the proposed one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shields.lookahead.candidates import completed, expressible, regulator
from shields.lookahead.plan_test import PlanTest
from shields.lookahead.prediction import Prediction
from shields.lookahead.program import PlanProgram
from shields.lookahead.tightening import Tightening
from shields.runtime.one_step_test import OneStepTest

# A first input this close to the proposed one, in units of the limits, is tried as the proposed one itself.
AS_PROPOSED = 1e-5
# Solvers cannot be copied to another process; they are set up where they are used.
_NOT_COPIED = {"_programs": {}}


class Plan(NamedTuple):
    """A certified plan.

    Attributes:
        inputs: u_0..u_{j-1}, shape (j, m) [physical units].
        distance: Euclidean distance of u_0 from the proposed input.
    """

    inputs: np.ndarray
    distance: float


class Planner:
    """Finds certified plans: candidates first, then the convex program for some lengths (docs/lookahead.md).

    Args:
        first: The one-step test.
        gain: K, shape (m, n).
        horizon: Largest length N of a plan.
        margin: By which plans must pass the test.

    Attributes:
        test: The plan test.
        horizon: N.
    """

    def __init__(self, first: OneStepTest, gain: np.ndarray, horizon: int, margin: float) -> None:
        self.test, self.horizon = PlanTest(Prediction(first, horizon), margin), horizon
        self._plant = first.plant
        braking = regulator(first.plant)
        self._gains = np.array([gain] if braking is None else [gain, braking])
        self._programs: dict[int, PlanProgram] = {}

    def __getstate__(self) -> dict:
        return self.__dict__ | _NOT_COPIED

    def find(
        self, estimates: np.ndarray, shapes: np.ndarray, proposed: np.ndarray, stored: np.ndarray
    ) -> list[Plan | None]:
        """Returns for each of E environments the certified plan found whose first input is closest; None without.

        Args:
            estimates: x_hat, shape (E, n).
            shapes: Sigma_k, shape (E, n, n).
            proposed: Inputs within the limits, shape (E, m).
            stored: Plans still stored, shape (E, N, m), NaN beyond their ends.
        """
        tightening = self.test.tightenings_of(shapes)
        candidates = self._candidates(estimates, proposed, stored)
        certified = self.test.certified(estimates, tightening, candidates)
        plans: list[Plan | None] = []
        for e, u in enumerate(proposed):
            plan = _closest(candidates[e], certified[e], u)
            if plan is None or plan.distance > 0.0:
                alone = Tightening(*(part[e : e + 1] for part in tightening))
                plan = self._solved(estimates[e : e + 1], alone, u, plan)
            plans.append(plan)
        return plans

    def _candidates(self, estimates: np.ndarray, proposed: np.ndarray, stored: np.ndarray) -> np.ndarray:
        """Returns the plans tried without a solver, shape (E, P, N, m)."""
        gains = len(self._gains)
        count, number = len(estimates), 2 * gains + 1
        beginnings = np.full((count, number, self.horizon, self._plant.m), np.nan)
        beginnings[:, : gains + 1, 0] = proposed[:, None]  # the proposal and each gain, and
        beginnings[:, gains, 1:] = stored[:, 1:]  # the proposal and what is stored for later;
        order = [*range(gains), 0, *range(gains)]  # each gain from the start
        return completed(self._plant, estimates, beginnings, self._gains[order])

    def _solved(self, estimate: np.ndarray, tightening: Tightening, proposed: np.ndarray, best: Plan | None):
        """Returns the closer of a plan and of those that the program finds, from short to long."""
        box, radius = self.test.room(estimate, tightening)
        for length in lengths(self.horizon):
            if length not in self._programs:
                self._programs[length] = PlanProgram(self.test.prediction, length)
            program, end = self._programs[length], length - 1
            turn = tightening.turn[0, end]
            found = program.solve(estimate[0], box[0, :end], turn, float(radius[0, end]), proposed)
            if found is None:
                continue
            plan = self._checked(estimate, tightening, proposed, found)
            if plan is not None and (best is None or plan.distance < best.distance):
                best = plan
            if best is not None and best.distance == 0.0:
                break
        return best

    def _checked(
        self, estimate: np.ndarray, tightening: Tightening, proposed: np.ndarray, found: np.ndarray
    ) -> Plan | None:
        """Returns what of a solver's plan is certified, as inputs that can be applied."""
        length, limits = len(found), self._plant.u_max
        tried = np.zeros((1, 2, self.horizon, self._plant.m))
        tried[0, :, :length] = expressible(found, limits)
        if (np.abs(found[0] - proposed) <= AS_PROPOSED * limits).all():
            tried[0, 0, 0] = proposed
        certified = self.test.certified(estimate, tightening, tried)
        certified[..., length:] = False
        return _closest(tried[0], certified[0], proposed)


def lengths(horizon: int) -> list[int]:
    """Returns the lengths that the program is tried with, the shorter first: half the horizon, and all of it.

    On the registered plants that admits as much as every length from 2 to N, in a third of the time or less.
    """
    return [length for length in (horizon // 2, horizon) if length > 1]


def _closest(plans: np.ndarray, certified: np.ndarray, proposed: np.ndarray) -> Plan | None:
    """Returns the certified plan with the closest first input, of equal ones the shortest.

    Args:
        plans: Shape (P, N, m).
        certified: Which of their first parts are, shape (P, N).
        proposed: Shape (m,).
    """
    if not certified.any():
        return None
    lengths = np.where(certified.any(axis=1), certified.argmax(axis=1) + 1, 0)
    distances = np.sqrt(np.square(plans[:, 0] - proposed).sum(axis=1))
    order = sorted((float(distances[p]), int(lengths[p]), p) for p in np.flatnonzero(lengths))
    distance, length, best = order[0]
    return Plan(plans[best, :length].copy(), distance)
