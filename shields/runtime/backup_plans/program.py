"""The convex program whose solution is tried as a plan; whatever a solver says about it is not believed."""

from __future__ import annotations

from typing import Any

import clarabel
import numpy as np
from scipy.sparse import csc_matrix

from ncs_gym.validation import read_only
from shields.runtime.backup_plans.plan_check import Prediction
from shields.verification import ACTION_ROUNDING

# Its types are not declared.
_clarabel: Any = clarabel
# What the program keeps away from the limits of the plan test, in units of the box and of S or P: the solver's
# precision.
SOLVER_MARGIN = 1e-7
MOST_ITERATIONS = 60


class PlanProgram:
    """min |u_0 - proposed|^2 over plans of N inputs that pass the plan test: linear rows, and one cone for an end in S.

    Variables are the inputs in units of their limits. The solver is set up once, with the pattern of the problem; then
    vectors and the entries of the cone are updated, so that a solution depends on its own data alone.

    Args:
        prediction: Of the plant.
    """

    def __init__(self, prediction: Prediction) -> None:
        plant, length = prediction.plant, prediction.steps
        self._m, self._length = plant.m, length
        self._limits, self._weights = plant.u_max, (plant.u_max / plant.u_max.max()) ** 2
        scale = np.tile(plant.u_max, length)
        self._free = prediction.free
        self._end = read_only(prediction.forced[-1] * scale)
        forced = prediction.forced[:-1] * scale
        self._C = prediction.rows[: len(plant.box_rows)]
        self._G, grid = prediction.rows[:0] if prediction.ends else prediction.rows, prediction.grid
        rows = np.concatenate([(self._C @ forced).reshape(-1, len(scale)), self._G @ self._end])
        self._between = np.empty((0, plant.n)) if grid is None else grid.free.reshape(-1, plant.n)
        if grid is not None:
            rows = np.concatenate([rows, (grid.forced * scale).reshape(-1, len(scale))])
        self._rows = read_only(np.concatenate([rows, -rows]))
        self._margin = SOLVER_MARGIN + float(ACTION_ROUNDING) * np.abs(rows).sum(axis=1)
        root = prediction.ends[-1].root if prediction.ends else np.empty((0, plant.n))
        self._cone = len(root) + 1 if len(root) else 0
        pushed = float(np.linalg.norm(root @ self._end, axis=0).sum())
        self._end_margin = SOLVER_MARGIN + float(ACTION_ROUNDING) * pushed
        self._arrange(root)
        self._solver: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_solver": None}  # set up anew where it is used

    def _arrange(self, root: np.ndarray) -> None:
        """Fixes where the entries of the matrix are, those of the cone being what changes."""
        size = self._length * self._m
        identity = np.eye(size)
        linear = np.concatenate([self._rows, identity, -identity])
        row, column = np.nonzero(linear)
        first = len(linear) + 1  # the row before holds the radius
        cone_rows, cone_columns = (each.ravel() for each in np.indices((len(root), size)))
        rows, columns = np.concatenate([row, first + cone_rows]), np.concatenate([column, cone_columns])
        self._entries = np.concatenate([linear[row, column], -(root @ self._end).ravel()])
        self._in_cone = slice(len(row), None)
        shape = len(linear) + self._cone, size
        numbered = csc_matrix((np.arange(1.0, len(rows) + 1.0), (rows, columns)), shape=shape)
        self._order = numbered.data.astype(np.intp) - 1
        numbered.data = self._entries[self._order]
        self._typical = numbered

    @np.errstate(all="ignore")  # what is not finite has no plan
    def solve(
        self,
        estimate: np.ndarray,
        room: np.ndarray,
        weighting: np.ndarray,
        radius: float,
        between: np.ndarray,
        proposed: np.ndarray,
    ) -> np.ndarray | None:
        """Returns a plan, shape (N, m) [physical units], of which nothing is known; None if the solver fails.

        Args:
            estimate: x_hat, shape (n,).
            room: Largest |row c_j| for j = 1..N, shape (N, r).
            weighting: T G of the last step, shape (n, n), or (0, n) for an end in P.
            radius: Largest |T G c_j| of the last step.
            between: Largest values of the rows of the grid in every step, shape (N, g).
            proposed: Shape (m,).

        Raises:
            ValueError: If an argument has another shape: that is no failure of the solver.
        """
        centers = self._free @ estimate
        moved = [(centers[:-1] @ self._C.T).ravel(), self._G @ centers[-1], self._between @ estimate]
        left = [room[:-1, : len(self._C)].ravel(), room[-1, : len(self._G)], between.ravel()]
        drift, allowed = np.concatenate(moved), np.concatenate(left) - self._margin
        ones = np.ones(2 * self._length * self._m)
        cone = np.concatenate([[radius - self._end_margin], weighting @ centers[-1]])[: self._cone]
        b = np.concatenate([allowed - drift, allowed + drift, ones, cone])
        q = np.zeros(self._length * self._m)
        q[: self._m] = -2.0 * self._weights * proposed / self._limits
        self._entries[self._in_cone] = -(weighting @ self._end).ravel()
        A = self._entries[self._order]
        if not (np.isfinite(b).all() and np.isfinite(A).all() and np.isfinite(q).all()):
            return None
        try:
            solver, self._solver = self._set_up() if self._solver is None else self._solver, None
            solver.update(A=A, b=b, q=q)
            plan = np.array(solver.solve().x, dtype=np.float64)
            self._solver = solver  # what did not come to its end is not used again
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException:  # whatever a solver does wrong (its panics are no Exceptions): another plan, or none
            return None
        usable = plan.shape == (self._length * self._m,) and np.isfinite(plan).all()
        return plan.reshape(self._length, self._m) * self._limits if usable else None

    def _set_up(self) -> Any:
        """Returns a solver with the pattern of the problem."""
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
