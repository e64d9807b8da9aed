"""The rule of mode "lookahead": what becomes of an input that fails the one-step test."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.validation import as_numbers
from shields.lookahead.planner import Planner
from shields.runtime.decisions import INVALID, PLANNED, PROJECTED, SAFE, STORED, Decision
from shields.runtime.one_step_test import OneStepTest
from shields.runtime.predicted_errors import PredictedErrors


class Lookahead:
    """Applies plans and stores what is left of them (docs/lookahead.md).

    Decisions of mode "project" come in. An input that passes the one-step test stays as it is, and nothing is stored
    any more: x+ is in S. Otherwise, among the projected input and the plans that are found, the input closest to the
    proposed one is applied and what follows it in its plan is stored. Without any, the next stored input is applied;
    where nothing is stored, K x_hat.

    Args:
        test: The one-step test.
        gain: K, shape (m, n).
        horizon: Longest plan, in steps.
        margin: By which plans must pass their test.

    Attributes:
        planner: Finds the plans.
    """

    def __init__(self, test: OneStepTest, gain: np.ndarray, horizon: int, margin: float) -> None:
        self._test, self._margin = test, margin
        self.planner = Planner(test, gain, horizon, margin)

    def complete(
        self,
        decided: Decision,
        estimates: np.ndarray,
        errors: PredictedErrors,
        proposed: np.ndarray,
        stored: np.ndarray,
    ) -> None:
        """Changes the decisions of mode "project" about N proposals to those of mode "lookahead", in place.

        Args:
            decided: Decisions whose `plan` is all NaN.
            estimates: x_hat, shape (n, N).
            errors: What is known of the Sigma_k of each.
            proposed: Shape (m, N) [physical units].
            stored: Plans still stored, shape (horizon, m, N), NaN beyond their ends.
        """
        some = np.flatnonzero(decided.reason != SAFE)
        if not some.size:
            return
        changed = np.zeros(some.shape, np.bool_)
        searched = np.flatnonzero(decided.reason[some] != INVALID)
        for i, plan in zip(
            searched.tolist(), self._plans(some[searched], estimates, errors, proposed, stored), strict=True
        ):
            e = some[i]
            projected = decided.reason[e] == PROJECTED
            if plan is None or (projected and plan.distance >= np.linalg.norm(decided.input[:, e] - proposed[:, e])):
                continue
            changed[i] = True
            decided.input[:, e], decided.plan[: len(plan.inputs) - 1, :, e] = plan.inputs[0], plan.inputs[1:]
            decided.passed[e], decided.fallback[e], decided.reason[e] = True, False, PLANNED
        left = ~changed & (decided.reason[some] != PROJECTED) & ~np.isnan(stored[0, 0, some])
        for e in some[left].tolist():
            decided.input[:, e], decided.plan[:-1, :, e] = stored[0, :, e], stored[1:, :, e]
            decided.fallback[e], decided.stored[e], decided.reason[e] = False, True, STORED
        some = some[changed | left]
        if some.size:
            decided.intervened[some] = (decided.input[:, some] != proposed[:, some]).any(axis=0)
            slack, decided.margin[some] = self._test.reachable(estimates[:, some], errors.of(some)).slack(
                decided.input[:, some]
            )
            decided.passed[some] = (slack >= self._margin) | (decided.reason[some] == PLANNED)

    def _plans(
        self, some: np.ndarray, estimates: np.ndarray, errors: PredictedErrors, proposed: np.ndarray, stored: np.ndarray
    ) -> list[Any]:
        """Returns the plans found for some environments."""
        if not some.size:
            return []
        shapes = errors.shape[..., some].transpose(2, 0, 1)
        return self.planner.find(
            np.ascontiguousarray(estimates[:, some].T),
            shapes,
            proposed[:, some].T,
            stored[..., some].transpose(2, 0, 1),
        )

    def knows_in_box(self, estimate: np.ndarray, errors: PredictedErrors) -> bool:
        """Returns whether an estimate, shape (n,), proves that x is in the box."""
        return errors.radius == errors.radius and self.planner.test.knows_in_box(estimate, errors.shape)

    def as_stored(self, plan: Any) -> np.ndarray:
        """Returns a plan, shape (k, m), as an array (horizon, m), NaN beyond its end; all NaN for what is no plan."""
        plant, numbers = self._test.plant, as_numbers(plan)
        stored = np.full((self.planner.horizon, plant.m), np.nan)
        if numbers is None or numbers.ndim != 2 or numbers.shape[1] != plant.m or len(numbers) > len(stored):
            return stored
        if (np.abs(numbers) <= plant.u_max).all():
            stored[: len(numbers)] = numbers
        return stored
