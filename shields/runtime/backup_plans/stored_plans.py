"""The rule of mode "lookahead": what becomes of an input that fails the test, and what is stored of its backup plan."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.validation import as_numbers
from shields.certificate import Fallback
from shields.runtime.backup_plans.plan_search import Planner, Plans
from shields.runtime.safety_filter import INVALID, PLANNED, PROJECTED, SAFE, STORED, Decision
from shields.runtime.set_test import PredictedErrors, ReachableSets, SetTest, norms


class Lookahead:
    """Applies plans and stores what is left of them (docs/lookahead.md).

    An input that passes the one-step test stays as it is, and nothing is stored any more: x+ is in the safe set. One
    that begins a certified plan stays as well, and what follows is stored (`keep`). Otherwise the decision of mode
    "project" is changed (`complete`): among the projected input and the plans that are found, the input closest to the
    proposed one is applied and what follows it in its plan is stored. Without any, the next stored input is applied;
    where nothing is stored, K x_hat.

    Its methods change decisions about N proposals in place, given the numbers of `some` of them, estimates x_hat (n,
    N), what is known of the Sigma_k of each, proposals (m, N) [physical units], and plans still stored (horizon, m, N),
    NaN beyond their ends.

    Args:
        test: The one-step test.
        fallback: The certificate's.
        horizon: Longest plan, in steps.
        margin: By which plans must pass their test.
    """

    def __init__(self, test: SetTest, fallback: Fallback, horizon: int, margin: float) -> None:
        self._test, self.horizon, self._margin = test, horizon, margin
        self.planner = Planner(test, fallback, horizon, margin)

    def beginning_alone(self, estimate: np.ndarray, errors: PredictedErrors, proposed: np.ndarray) -> np.ndarray | None:
        """Returns a plan, (j, m), of a single environment that begins with what is proposed, if one is soon found."""
        return self.planner.beginning_alone(estimate, errors.shape, proposed)

    def may_do_better(
        self,
        estimate: np.ndarray,
        errors: PredictedErrors,
        proposed: np.ndarray,
        projected: np.ndarray,
        stored: Any,
    ) -> bool:
        """Returns whether a plan might begin closer than a projected input does; if not, that stays as it is."""
        if not np.isnan(self.as_stored(stored)[0, 0]):
            return True
        return self.planner.may_do_better(estimate, errors.shape, proposed, projected)

    def keep(
        self, decided: Decision, valid: np.ndarray, estimates: np.ndarray, errors: PredictedErrors, stored: np.ndarray
    ) -> None:
        """Lets inputs within the limits (`valid`, shape (N,)) pass where a plan begins with them.

        Of these decisions `input` is the proposed one, and `plan` is all NaN.
        """
        some = np.flatnonzero(valid & ~decided.proved)
        if some.size:
            known = self._rows(some, estimates, errors, decided.input, stored)
            found = self.planner.beginning_with(*known)
            begun = self._begin(decided, some, found)
            decided.intervened[some[begun]] = False

    def complete(
        self,
        decided: Decision,
        sets: ReachableSets,
        estimates: np.ndarray,
        errors: PredictedErrors,
        proposed: np.ndarray,
        stored: np.ndarray,
    ) -> None:
        """Changes decisions of mode "project" about proposals that were not let pass."""
        some = np.flatnonzero((decided.reason != PLANNED) & (decided.reason != SAFE))
        if not some.size:
            return
        changed = np.zeros(some.shape, np.bool_)
        searched = np.flatnonzero(decided.reason[some] != INVALID)
        if searched.size:
            changed[searched] = self._plan(decided, some[searched], estimates, errors, proposed, stored)
        left = ~changed & (decided.reason[some] != PROJECTED) & ~np.isnan(stored[0, 0, some])
        resumed = some[left]
        decided.input[:, resumed], decided.plan[:-1, :, resumed] = stored[0][:, resumed], stored[1:, :, resumed]
        decided.fallback[resumed], decided.stored[resumed], decided.reason[resumed] = False, True, STORED
        some = some[changed | left]
        if some.size:
            decided.intervened[some] = (decided.input[:, some] != proposed[:, some]).any(axis=0)
            test_margin, decided.margin[some] = sets.some(some).margins(decided.input[:, some])
            decided.proved[some] = (test_margin >= self._margin) | (decided.reason[some] == PLANNED)

    def _plan(
        self,
        decided: Decision,
        some: np.ndarray,
        estimates: np.ndarray,
        errors: PredictedErrors,
        proposed: np.ndarray,
        stored: np.ndarray,
    ) -> np.ndarray:
        """Begins new plans where one is found that is closer than the input that passes; returns where."""
        passes = decided.reason[some] == PROJECTED
        closest = np.where(passes, decided.input[:, some], np.nan)
        x_hat, shapes, wanted, plans = self._rows(some, estimates, errors, proposed, stored)
        found = self.planner.find(x_hat, shapes, wanted, closest.T, plans)
        found.lengths[passes & (found.distances >= norms(closest - proposed[:, some]))] = 0
        return self._begin(decided, some, found)

    def _rows(
        self, some: np.ndarray, estimates: np.ndarray, errors: PredictedErrors, inputs: np.ndarray, stored: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        x_hat, shapes = np.ascontiguousarray(estimates[:, some].T), errors.shape[..., some].transpose(2, 0, 1)
        return x_hat, shapes, inputs[:, some].T, stored[..., some].transpose(2, 0, 1)

    def _begin(self, decided: Decision, some: np.ndarray, found: Plans) -> np.ndarray:
        """Begins the plans found for some environments, and returns where there are any, shape (len(some),)."""
        begun = found.lengths > 0
        if not np.count_nonzero(begun):
            return begun
        inputs, lengths = found.inputs[begun], found.lengths[begun]
        kept = np.arange(1, self.horizon) < lengths[:, None]
        some = some[begun]
        decided.input[:, some] = inputs[:, 0].T
        decided.plan[:-1, :, some] = np.where(kept[..., None], inputs[:, 1:], np.nan).transpose(1, 2, 0)
        decided.proved[some], decided.fallback[some], decided.reason[some] = True, False, PLANNED
        return begun

    def knows_in_box(self, estimate: np.ndarray, errors: PredictedErrors) -> bool:
        """Returns whether an estimate, shape (n,), proves that x is in the box."""
        return errors.radius == errors.radius and self.planner.test.knows_in_box(estimate, errors.shape)

    def as_stored(self, plan: Any) -> np.ndarray:
        """Returns a plan, shape (k, m), as an array (horizon, m), NaN beyond its end; all NaN for what is no plan."""
        plant, numbers = self._test.plant, as_numbers(plan)
        stored = np.full((self.horizon, plant.m), np.nan)
        if numbers is None or numbers.ndim != 2 or numbers.shape[1] != plant.m or len(numbers) > len(stored):
            return stored
        numbers = numbers.copy()  # read once
        if ((plant.input_ends[0] <= numbers) & (numbers <= plant.input_ends[1])).all():
            stored[: len(numbers)] = numbers
        return stored

    def all_as_stored(self, plans: np.ndarray) -> np.ndarray:
        """Returns plans, shape (N, horizon, m), NaN beyond their ends; all NaN for those that are none."""
        plant = self._test.plant
        given: np.ndarray = np.asarray(~np.isnan(plans).all(axis=2))
        within = ((plant.input_ends[0] <= plans) & (plans <= plant.input_ends[1])).all(axis=2)
        goes_on = given[:, :-1] | ~given[:, 1:]
        is_plan = np.all(given == within, axis=1) & np.all(goes_on, axis=1)
        return np.where(np.reshape(is_plan, (-1, 1, 1)), plans, np.nan)
