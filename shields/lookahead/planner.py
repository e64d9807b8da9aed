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


class Plan(NamedTuple):
    """A certified plan.

    Attributes:
        inputs: u_0..u_{j-1}, shape (j, m) [physical units].
        distance: Euclidean distance of u_0 from the proposed input.
    """

    inputs: np.ndarray
    distance: float


class Planner:
    """Finds certified plans: candidates first, then the convex program (docs/lookahead.md).

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
        self._program = PlanProgram(self.test.prediction)

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
        plans = [_closest(*each) for each in zip(candidates, certified, proposed, strict=True)]
        left = [e for e, plan in enumerate(plans) if plan is None or plan.distance > 0.0]
        if left and self.horizon > 1:
            some = Tightening(*(part[left] for part in tightening))
            for e, plan in zip(left, self._solved(estimates[left], some, proposed[left]), strict=True):
                if plan is not None:
                    plans[e] = min(plan, plans[e] or plan, key=lambda each: each.distance)
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

    def _solved(self, estimates: np.ndarray, tightening: Tightening, proposed: np.ndarray) -> list[Plan | None]:
        """Returns what of the program's plans is certified, as inputs that can be applied.

        The program is solved for the whole horizon: on the registered plants that admits as much, and comes as close,
        as every shorter length besides. Of its plan the shortest part that is certified counts.

        Args:
            estimates: x_hat, shape (E, n).
            tightening: Of the error shapes of each.
            proposed: Shape (E, m).
        """
        limits, (box, radius) = self._plant.u_max, self.test.room(estimates, tightening)
        tried = np.full((len(estimates), 2, self.horizon, self._plant.m), np.nan)
        for e, u in enumerate(proposed):
            data = estimates[e], box[e, :-1], tightening.turn[e, -1], float(radius[e, -1]), u
            if (found := self._program.solve(*data)) is not None:
                tried[e] = expressible(found, limits)
                if (np.abs(found[0] - u) <= AS_PROPOSED * limits).all():
                    tried[e, 0, 0] = u
        certified = self.test.certified(estimates, tightening, tried)
        return [_closest(*each) for each in zip(tried, certified, proposed, strict=True)]


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
