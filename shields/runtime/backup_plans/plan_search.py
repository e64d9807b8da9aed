"""The search for a certified plan whose first input is close to the proposed one.

Candidates come first: a given beginning, and then a gain at the predicted centers, limited or saturated. The solution
of a convex program is tried last; whatever a solver says about it is not believed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import clarabel
import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.envs.spaces import expressible
from ncs_gym.plants.lqr import lqr_gain
from ncs_gym.validation import read_only
from shields.certificate import Fallback
from shields.runtime.backup_plans.plan_check import PlanTest, Prediction, Tightening
from shields.runtime.set_test import SetTest
from shields.verification import ACTION_ROUNDING

# Its types are not declared.
_clarabel: Any = clarabel
# A first input this close to the proposed one, in units of the limits, is tried as the proposed one itself.
AS_PROPOSED = 1e-5
# Weight of inputs, in units of their limits, against states, in units of the box, in the regulator that brakes, and in
# the one whose prediction knows no limits: it has to keep them by itself.
INPUT_WEIGHT, UNLIMITED_INPUT_WEIGHT = 1e-2, 1.0
# What the program keeps away from the limits of the plan test, in units of the box and of S or P: the solver's
# precision.
SOLVER_MARGIN = 1e-7
MOST_ITERATIONS = 60


class Plans(NamedTuple):
    """Certified plans of E environments.

    Attributes:
        inputs: u_0..u_{N-1}, shape (E, N, m) [physical units]; beyond a plan's length they are not certified.
        lengths: Shape (E,), 0 where no plan is certified.
        distances: Euclidean distances of u_0 from the proposed inputs, shape (E,), infinite without a plan.
    """

    inputs: np.ndarray
    lengths: np.ndarray
    distances: np.ndarray


class Planner:
    """Finds certified plans (docs/lookahead.md).

    Its methods take, of E environments, estimates x_hat (E, n), error shapes Sigma_k (E, n, n), proposed inputs within
    the limits (E, m), and plans still stored (E, N, m), NaN beyond their ends.

    Args:
        first: The one-step test.
        fallback: The certificate's: the regulators have gains of their own around the same resting point.
        horizon: Largest length N of a plan.
        margin: By which plans must pass the test.

    Attributes:
        test: The plan test.
    """

    def __init__(self, first: SetTest, fallback: Fallback, horizon: int, margin: float) -> None:
        self.test, self.horizon = PlanTest(Prediction(first, horizon), margin), horizon
        self._plant, self._fallback, gain = first.plant, fallback, fallback.gain
        self._rest = read_only(np.concatenate(fallback[1:]))
        braking, unlimited = regulator(first.plant), regulator(first.plant, UNLIMITED_INPUT_WEIGHT)
        self._gains = np.array([gain if braking is None else braking, gain])
        loops = [closed_loop(first.plant, gain if each is None else each, horizon) for each in (unlimited, gain)]
        self._loops = np.concatenate(loops, axis=1)
        self._program = PlanProgram(self.test.prediction)

    def beginning_alone(self, estimate: np.ndarray, shape: np.ndarray, proposed: np.ndarray) -> np.ndarray | None:
        """Returns a plan, (j, m), of a single environment, if the first candidates of `beginning_with` are enough."""
        tightening = self.test.tightenings_of(shape[None])
        if not self.test.may_begin(estimate[None], tightening, proposed[None])[0]:
            return None
        plans = self._continued(estimate, proposed)
        certified = self.test.certified(estimate[None], tightening, plans[None])[0]
        which = int(certified.any(axis=1).argmax())
        more = int(certified[which].argmax())
        return plans[which, : 1 + more] if certified[which, more] else None

    def may_do_better(
        self, estimate: np.ndarray, shape: np.ndarray, proposed: np.ndarray, projected: np.ndarray
    ) -> bool:
        """Returns whether `beginning_with` or `find` might find a plan, for one environment that has none stored."""
        x_hat, u = estimate[None], proposed[None]
        beginnings = np.full((1, 4, 1, len(proposed)), np.nan)
        beginnings[0, 0, 0] = projected
        if self._begins_closer(x_hat, u, beginnings)[0]:
            return True
        return bool(self.test.may_begin(x_hat, self.test.tightenings_of(shape[None]), u)[0])

    def _begins_closer(self, estimates: np.ndarray, proposed: np.ndarray, beginnings: np.ndarray) -> np.ndarray:
        """Returns where a candidate of `find` begins closer than the projected input, or need not, shape (E,).

        The projected inputs are the first of the first beginnings, NaN where there are none; shape (E, 4, any, m).
        """
        if self.test.prediction.ends:
            return np.ones(len(estimates), np.bool_)
        projected_at, *others_at = _distances(self._completed(estimates, beginnings[:, :, :1]), proposed).T
        return np.isnan(beginnings[:, 0, 0, 0]) | np.any(others_at < projected_at, axis=0)

    def beginning_with(
        self, estimates: np.ndarray, shapes: np.ndarray, proposed: np.ndarray, stored: np.ndarray
    ) -> Plans:
        """Returns certified plans whose first inputs are the proposed ones.

        After the proposal comes a regulator or K in a prediction that knows no limits, what is stored for later and
        then K, or the saturated regulator. The first candidate that is certified counts; the solver is not asked.
        """
        tightening, continued = self.test.tightenings_of(shapes), self._continued(estimates, proposed)
        plans = self._best(estimates, tightening, continued[:, :1], proposed)
        left = np.flatnonzero(plans.lengths == 0)
        left = left[self.test.may_begin(estimates[left], tightening.some(left), proposed[left])]
        for next_of in (
            lambda some: continued[some, 1:],
            lambda some: self._limited(estimates[some], proposed[some], stored[some]),
        ):
            if not left.size:
                break
            found = self._best(estimates[left], tightening.some(left), next_of(left), proposed[left])
            self.improve(plans, left, found)
            left = left[plans.lengths[left] == 0]
        return plans

    def _limited(self, estimates: np.ndarray, proposed: np.ndarray, stored: np.ndarray) -> np.ndarray:
        beginnings = np.full((len(estimates), 2, self.horizon, self._plant.m), np.nan)
        beginnings[:, :, 0] = proposed[:, None]
        beginnings[:, 0, 1:] = stored[:, 1:]
        return completed(self._plant, self._fallback, estimates, beginnings, self._gains[::-1])

    def _continued(self, estimates: np.ndarray, proposed: np.ndarray) -> np.ndarray:
        """Returns proposals followed by either loop, (E, 2, N, m), limited after the prediction: one product for all.

        A single estimate, shape (n,), and proposal, (m,), give plans without the first axis.
        """
        inputs = (np.concatenate([estimates, proposed], axis=-1) - self._rest) @ self._loops
        inputs = inputs.reshape(*inputs.shape[:-1], 2, self.horizon, -1) + self._fallback.resting_input
        plans = expressible(inputs, self._plant)
        plans[..., 0, :] = proposed[..., None, :]
        return plans

    def find(
        self,
        estimates: np.ndarray,
        shapes: np.ndarray,
        proposed: np.ndarray,
        projected: np.ndarray,
        stored: np.ndarray,
    ) -> Plans:
        """Returns certified plans whose first inputs are close to the proposed ones.

        Candidates are the projected input and then the regulator, what is stored, and either gain from the start. The
        solver is asked where none of them is certified; where plans end in S also if nothing is stored. Plans that end
        in P would begin closer by it in a single step, but not in a loop (docs/lookahead.md), for three times the time.
        `projected` are the closest inputs that pass the one-step test, shape (E, m), NaN where there are none. Where
        there is one and plans end in P, a plan of any length is looked for only if a candidate begins closer.
        """
        beginnings = np.full((len(estimates), 4, self.horizon, self._plant.m), np.nan)
        beginnings[:, 0, 0], beginnings[:, 1] = projected, stored
        nothing = np.zeros((len(estimates), self.horizon, self._plant.m))
        plans = Plans(nothing, np.zeros(len(estimates), np.int64), np.full(len(estimates), np.inf))
        some = np.flatnonzero(self._begins_closer(estimates, proposed, beginnings))
        if some.size:
            known = (each[some] for each in (estimates, shapes, proposed, stored, beginnings))
            self.improve(plans, some, self._found(*known))
        return plans

    def _found(
        self,
        estimates: np.ndarray,
        shapes: np.ndarray,
        proposed: np.ndarray,
        stored: np.ndarray,
        beginnings: np.ndarray,
    ) -> Plans:
        """Returns the plans of `find`, of candidates with these beginnings, shape (E, 4, N, m), or of the solver."""
        tightening, candidates = self.test.tightenings_of(shapes), self._completed(estimates, beginnings)
        plans = self._best(estimates, tightening, candidates, proposed)
        if self.horizon > 1:
            needed = plans.lengths == 0
            if self.test.prediction.ends:
                needed |= np.isnan(stored[:, 0, 0])
            left = np.flatnonzero(needed & (plans.distances > 0.0))
            if left.size:
                self.improve(plans, left, self._solved(estimates[left], tightening.some(left), proposed[left]))
        return plans

    def _completed(self, estimates: np.ndarray, beginnings: np.ndarray) -> np.ndarray:
        return completed(self._plant, self._fallback, estimates, beginnings, self._gains[[0, 1, 0, 1]])

    def improve(self, plans: Plans, chosen: np.ndarray, others: Plans) -> None:
        """Puts other plans of the environments chosen in place where they begin closer."""
        better = others.distances < plans.distances[chosen]
        for part, improved in zip(plans, others, strict=True):
            part[chosen[better]] = improved[better]

    def _best(
        self,
        estimates: np.ndarray,
        tightening: Tightening,
        plans: np.ndarray,
        proposed: np.ndarray,
    ) -> Plans:
        """Returns one certified plan of P for each environment, shape (E, P, N, m).

        Of each the shortest certified beginning counts; the one that begins closest is returned, of equal ones the
        first.
        """
        certified = self.test.certified(estimates, tightening, plans)
        lengths = np.where(certified.any(axis=-1), 1 + certified.argmax(axis=-1), 0)
        distances = np.where(lengths > 0, _distances(plans, proposed), np.inf)
        best, rows = distances.argmin(axis=1), np.arange(len(plans))
        return Plans(*(part[rows, best] for part in (plans, lengths, distances)))

    def _solved(self, estimates: np.ndarray, tightening: Tightening, proposed: np.ndarray) -> Plans:
        """Returns the shortest certified parts of the program's plans, as inputs that can be applied.

        The program is solved for the whole horizon, which admits as much as all shorter ones on the registered plants.
        """
        row_limits, radius = self.test.limits_at(estimates, tightening)
        tried = np.full((len(estimates), 2, self.horizon, self._plant.m), np.nan)
        for e, u in enumerate(proposed):
            last = tightening.weighting[e, -1], float(radius[e, -1])
            found = self._program.solve(estimates[e], row_limits[e], *last, tightening.between[e], u)
            if found is not None:
                tried[e] = expressible(found, self._plant)
                if (np.abs(found[0] - u) <= AS_PROPOSED * self._plant.input_half).all():
                    tried[e, 0, 0] = u
        return self._best(estimates, tightening, tried, proposed)


def _distances(plans: np.ndarray, proposed: np.ndarray) -> np.ndarray:
    """Returns how far plans, (E, P, N, m), begin from the proposed inputs, (E, m): Euclidean, shape (E, P)."""
    return np.sqrt(np.square(plans[:, :, 0] - proposed[:, None]).sum(axis=-1))


class PlanProgram:
    """min |u_0 - proposed|^2 over plans of N inputs that pass the plan test: linear rows, and one cone for an end in S.

    Variables are the inputs from the middle of their limits, in units of half the range. A solver is set up once, with
    the pattern of the problem; then vectors and the entries of the cone are updated, so that a solution depends on its
    own data alone. Whoever solves takes the solver away, or sets another one up if somebody has it: threads share none.
    """

    _solver: Any = None  # while nobody uses it

    def __init__(self, prediction: Prediction) -> None:
        plant, length = prediction.plant, prediction.steps
        self._m, self._length = plant.m, length
        self._half, self._weights = plant.input_half, (plant.input_half / plant.input_half.max()) ** 2
        self._middle, scale = plant.input_middle, np.tile(plant.input_half, length)
        self._free = prediction.powers[1:]
        self._end = read_only(prediction.forced[-1] * scale)
        forced = prediction.forced[:-1] * scale
        self._C = prediction.rows[: len(plant.box)]
        self._G = prediction.rows[:0] if prediction.ends else prediction.rows
        steady = np.tile(self._middle, length)
        self._pushed = read_only(prediction.forced @ steady)
        middle, within = prediction.middle, prediction.within
        middles = [np.tile(middle[: len(self._C)], length - 1), middle[: len(self._G)], np.tile(within.middle, length)]
        middles[2] = middles[2] - (within.forced @ steady).ravel()
        self._middles = read_only(np.concatenate(middles))
        self._between = prediction.within.free.reshape(-1, plant.n)
        between = (prediction.within.forced * scale).reshape(-1, len(scale))
        rows = np.concatenate([(self._C @ forced).reshape(-1, len(scale)), self._G @ self._end, between])
        self._rows = read_only(np.concatenate([rows, -rows]))
        self._margin = SOLVER_MARGIN + float(ACTION_ROUNDING) * np.abs(rows).sum(axis=1)
        root = prediction.cone
        self._cone = len(root) + 1 if len(root) else 0
        pushed = float(np.linalg.norm(root @ self._end, axis=0).sum())
        self._end_margin = SOLVER_MARGIN + float(ACTION_ROUNDING) * pushed
        self._arrange(root)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_solver": None}  # set up anew where it is used

    def _arrange(self, root: np.ndarray) -> None:
        """Fixes where the entries of the matrix are, those of the cone being what changes."""
        size = self._length * self._m
        identity = np.eye(size)
        from scipy.sparse import csc_matrix  # takes long to import

        linear = np.concatenate([self._rows, identity, -identity])
        row, column = np.nonzero(linear)
        first = len(linear) + 1  # the row before holds the radius
        cone_rows, cone_columns = (each.ravel() for each in np.indices((len(root), size)))
        rows, columns = np.concatenate([row, first + cone_rows]), np.concatenate([column, cone_columns])
        self._linear = read_only(linear[row, column])
        shape = len(linear) + self._cone, size
        numbered = csc_matrix((np.arange(1.0, len(rows) + 1.0), (rows, columns)), shape=shape)
        self._order = numbered.data.astype(np.intp) - 1
        numbered.data = np.concatenate([self._linear, -(root @ self._end).ravel()])[self._order]
        self._typical = numbered

    def solve(
        self,
        estimate: np.ndarray,
        row_limits: np.ndarray,
        weighting: np.ndarray,
        radius: float,
        between: np.ndarray,
        proposed: np.ndarray,
    ) -> np.ndarray | None:
        """Returns a plan, shape (N, m) [physical units], of which nothing is known; None if the solver fails.

        Args:
            estimate: x_hat, shape (n,).
            row_limits: Largest distance of row c_j from its middle for j = 1..N, shape (N, r).
            weighting: T G of the last step, shape (n, n), or (0, n) for an end in P.
            radius: Largest |T G c_j| of the last step.
            between: Largest distances of the rows within a step from their middles in every step, shape (N, g).
            proposed: Shape (m,).
        """
        centers = self._free @ estimate + self._pushed
        moved = [(centers[:-1] @ self._C.T).ravel(), self._G @ centers[-1], self._between @ estimate]
        left = [row_limits[:-1, : len(self._C)].ravel(), row_limits[-1, : len(self._G)], between.ravel()]
        drift, allowed = np.concatenate(moved) - self._middles, np.concatenate(left) - self._margin
        ones = np.ones(2 * self._length * self._m)
        cone = np.concatenate([[radius - self._end_margin], weighting @ centers[-1]])[: self._cone]
        b = np.concatenate([allowed - drift, allowed + drift, ones, cone])
        q = np.zeros(self._length * self._m)
        q[: self._m] = -2.0 * self._weights * (proposed - self._middle) / self._half
        A = np.concatenate([self._linear, -(weighting @ self._end).ravel()])[self._order]
        if not (np.isfinite(b).all() and np.isfinite(A).all() and np.isfinite(q).all()):
            return None
        try:
            solver = vars(self).pop("_solver", None) or self._set_up()  # no other thread gets the same
            solver.update(A=A, b=b, q=q)
            plan = np.array(solver.solve().x, dtype=np.float64)
            self._solver = solver  # what did not come to its end is not used again
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException:  # whatever a solver does wrong (its panics are no Exceptions): another plan, or none
            return None
        usable = plan.shape == (self._length * self._m,) and np.isfinite(plan).all()
        return plan.reshape(self._length, self._m) * self._half + self._middle if usable else None

    def _set_up(self) -> Any:
        """Returns a solver with the pattern of the problem."""
        from scipy.sparse import csc_matrix

        size, settings = self._length * self._m, _clarabel.DefaultSettings()
        settings.verbose, settings.presolve_enable, settings.max_iter = False, False, MOST_ITERATIONS
        settings.input_sparse_dropzeros = False
        # Everything is in units of its limits already.
        settings.equilibrate_enable = False
        settings.max_threads = 1
        P = np.zeros(size)
        P[: self._m] = 2.0 * self._weights
        count = len(self._rows) + 2 * size
        cones = [_clarabel.NonnegativeConeT(count)]
        cones += [_clarabel.SecondOrderConeT(self._cone)] if self._cone else []
        b = np.ones(count + self._cone)
        return _clarabel.DefaultSolver(csc_matrix(np.diag(P)), np.zeros(size), self._typical, b, cones, settings)


def regulator(plant: LinearPlant, input_weight: float = INPUT_WEIGHT) -> np.ndarray | None:
    """Returns the gain, shape (m, n), of a linear-quadratic regulator; None if there is none."""
    return lqr_gain(plant.A, plant.B, plant.weight, input_weight * np.diag(plant.input_half**-2.0))


def closed_loop(plant: LinearPlant, gain: np.ndarray, steps: int) -> np.ndarray:
    """Returns the matrix, shape (n + m, steps m), that takes a row (x_hat, u_0) to u_0, u_1 = gain c_1, gain c_2, ...

    All of them from a resting point, without limits of inputs.
    """
    center, inputs = np.hstack([plant.A, plant.B]), [np.eye(plant.n + plant.m)[plant.n :]]
    for _ in range(steps - 1):
        inputs.append(gain @ center)
        center = (plant.A + plant.B @ gain) @ center
    return np.ascontiguousarray(np.concatenate(inputs).T)


def completed(
    plant: LinearPlant, fallback: Fallback, estimates: np.ndarray, beginnings: np.ndarray, gains: np.ndarray
) -> np.ndarray:
    """Returns plans that go on with u_j = u_c + gain (c_j - x_c), saturated and expressible, where a beginning is NaN.

    Of estimates x_hat, (E, n), beginnings of P plans, (E, P, N, m), and gains (P, m, n); the fallback has the resting
    point.
    """
    number, steps = beginnings.shape[1:3]
    plans = np.ascontiguousarray(beginnings.transpose(2, 1, 0, 3))  # products with few large matrices are fast
    missing: np.ndarray = np.asarray(np.isnan(plans))
    flat = missing.reshape(steps, -1)
    some, every = np.any(flat, axis=1), np.all(flat, axis=1)
    turned, A, B = gains.swapaxes(1, 2), plant.A.T, plant.B.T
    constants = np.array([fallback._replace(gain=gain).constant for gain in gains])[:, None]
    centers = np.repeat(estimates[None], number, axis=0)
    for j in range(steps):
        u = plans[j]
        if some[j]:
            gained = np.minimum(np.maximum(centers @ turned + constants, plant.input_ends[0]), plant.input_ends[1])
            u = plans[j] = gained if every[j] else np.where(missing[j], gained, u)
        if j + 1 < steps:
            centers = centers @ A + u @ B
    plans = np.where(missing, expressible(plans, plant), plans)
    return np.ascontiguousarray(plans.transpose(2, 1, 0, 3))
