"""A predictive safety filter as people build it: a nominal model predictive program from the estimate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ncs_gym import LinearPlant
from shields import Certificate
from shields.runtime.backup_plans.plan_check import Prediction
from shields.runtime.backup_plans.program import PlanProgram
from shields.runtime.one_step import OneStepTest
from shields.runtime.polytope_step import PolytopeTest
from shields.verification import require_valid

# Steps that are looked ahead; a tube leaves no room for more than a few.
HORIZON, TUBE_HORIZON = 20, 3
# A solution may miss the limits of box and safe set by this much, as solvers do.
TOLERANCE = 1e-6


class PredictiveFilter:
    """The closest input from which a nominal plan exists that ends in the safe set.

    It solves, with x_0 = x_hat taken for the true state and neither disturbance nor error set,

        min |u_0 - proposed|^2  s.t.  x_{i+1} = A x_i + B u_i,  |u_i| <= u_max,
                                      |c_j x_i| <= 1 - t_ij (0 < i < N),  |x_N|_M <= 1 - t_N,

    or |g x_N| <= 1 - t_N(g) for the rows g of the certificate's polytope, if it has one.
    The tightenings t are zero, a margin, the same for all, or those of a tube: with u_i + K (x_hat_i - x_i) applied,
    the true state is off x_i by (A+BK)^i e_0 + sum_j (A+BK)^j (B K e + d), each term as large as the certificate's
    error sets and the plant's disturbance let it be. Where the proposed input followed by u = K x is such a plan
    already, nothing is solved. Where the program has no solution, the rest of the last plan is applied, as the authors
    do, and u = K x_hat when it is used up.

    After Wabersich and Zeilinger 2018 and Wabersich and Zeilinger 2021, both of which tighten; the tube of an estimate
    is that of Mayne et al. 2006 (docs/bibliography.md).

    Args:
        certificate: Gives S and K; verified exactly here.
        plant: The plant it was made for.
        horizon: N [steps], at least 2.
        margin: Fraction of box and safe set that is kept free.
        tube: Whether the tightenings are those of the tube, beside the margin.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
    """

    def __init__(
        self,
        certificate: Certificate,
        plant: LinearPlant,
        horizon: int = HORIZON,
        margin: float = 0.0,
        *,
        tube: bool = False,
    ) -> None:
        require_valid(certificate, plant)
        self._plant, self._K, self._horizon = plant, certificate.K, horizon
        self._plans = np.empty((0, horizon - 1, plant.m))
        polytope = certificate.polytope
        test = OneStepTest(certificate.L, plant) if polytope is None else PolytopeTest(polytope, plant)
        self._root = np.linalg.cholesky(certificate.M).T if polytope is None else polytope.rows
        self._ends_in_ellipsoid = polytope is None
        self._prediction = Prediction(test, horizon)
        self._program = PlanProgram(self._prediction)
        self._room = np.full((horizon - 1, len(plant.box_rows)), 1.0 - margin)
        self._end_room = np.full(1 if polytope is None else len(polytope.rows), 1.0 - margin)
        if tube:
            reach, end = _tube(certificate, plant, self._end_sizes, horizon)
            self._room, self._end_room = self._room - reach, self._end_room - end
        # As the program takes it: the last row is for ends in P.
        self._all_room = np.ones((horizon, max(self._room.shape[1], len(self._end_room))))
        self._all_room[:-1, : self._room.shape[1]] = self._room
        self._all_room[-1, : len(self._end_room)] = self._end_room
        self._weighting = self._root if polytope is None else self._root[:0]
        grid = self._prediction.grid
        self._between = np.ones((horizon, 0 if grid is None else grid.free.shape[1]))

    def __call__(self, estimates: np.ndarray, proposed: np.ndarray, begun: np.ndarray) -> np.ndarray:
        """Returns the inputs to apply, shape (N, m).

        Args:
            estimates: x_hat, shape (N, n).
            proposed: Shape (N, m) [physical units].
            begun: Where an episode has just begun, shape (N,): earlier plans do not count.
        """
        if len(self._plans) != len(estimates):
            self._plans = np.full((len(estimates), self._horizon - 1, self._plant.m), np.nan)
        self._plans[begun] = np.nan
        applied, (fine, plans) = proposed.copy(), self._followed_by_gain(estimates, proposed)
        self._plans[fine] = plans[fine]
        for e in np.flatnonzero(~fine).tolist():
            plan = self._solved(estimates[e], proposed[e])
            if plan is None:
                plan = np.concatenate([self._plans[e], np.full((1, self._plant.m), np.nan)])
            if np.isnan(plan[0]).any():
                plan[0] = self._gained(estimates[e])
            applied[e], self._plans[e] = plan[0], plan[1:]
        return applied

    def _followed_by_gain(self, estimates: np.ndarray, proposed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns where a proposed input and then u = K x are a plan, (N,), and these inputs, (N, horizon - 1, m)."""
        plant, plans = self._plant, []
        states = estimates @ plant.A.T + proposed @ plant.B.T
        fine = np.ones(len(states), np.bool_)
        for room in self._room:
            fine &= (np.abs(states @ plant.box_rows.T) <= room).all(axis=1)
            plans.append(self._gained(states))
            states = states @ plant.A.T + plans[-1] @ plant.B.T
        return fine & (self._levels(states) <= self._end_room).all(axis=-1), np.stack(plans, axis=1)

    def _solved(self, estimate: np.ndarray, proposed: np.ndarray) -> np.ndarray | None:
        """Returns the inputs of the best plan, shape (horizon, m); None if the solver finds none."""
        plant = self._plant
        missed = np.abs(plant.box_rows @ plant.A @ estimate) - np.abs(plant.box_rows @ plant.B) @ plant.u_max
        if not (missed <= self._room[0]).all() or (self._end_room <= 0.0).any():
            return None  # no input brings the next state into the box, or nothing is left of the end
        radius = float(self._end_room[0])  # counts for ends in S
        plan = self._program.solve(estimate, self._all_room, self._weighting, radius, self._between, proposed)
        if plan is None:
            return None
        plan = np.clip(plan, -plant.u_max, plant.u_max)
        centers = self._prediction.centers(estimate[None], plan[None, None])[..., 0, 0]
        inside = (np.abs(centers[:-1] @ plant.box_rows.T) <= self._room + TOLERANCE).all()
        return plan if inside and (self._levels(centers[-1]) <= self._end_room + TOLERANCE).all() else None

    def _levels(self, states: np.ndarray) -> np.ndarray:
        """Returns |x|_M, shape (..., 1), or |g x| for all rows of P, shape (..., r), of states (..., n)."""
        values = states @ self._root.T
        return np.linalg.norm(values, axis=-1, keepdims=True) if self._ends_in_ellipsoid else np.abs(values)

    def _end_sizes(self, shape: np.ndarray) -> np.ndarray:
        """Returns the largest levels in an ellipsoid of a shape (n, n): shape (1,) or (r,)."""
        moved = self._root @ shape @ self._root.T
        return np.sqrt(np.maximum(np.linalg.eigvalsh(moved)[-1:] if self._ends_in_ellipsoid else np.diag(moved), 0.0))

    def _gained(self, states: np.ndarray) -> np.ndarray:
        """Returns u = K x within the limits, shape (m,) or (N, m)."""
        return np.clip(states @ self._K.T, -self._plant.u_max, self._plant.u_max)


def _tube(
    certificate: Certificate, plant: LinearPlant, end_sizes: Callable[[np.ndarray], np.ndarray], horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns how far true states are off a plan in the rows of the box, shape (N - 1, k), and at its end.

    Args:
        certificate: Gives the error sets and K.
        plant: The plant.
        end_sizes: Returns how far the states of an ellipsoid of a given shape reach at the end.
        horizon: N.
    """
    K, rows = certificate.K, plant.box_rows
    first = list(certificate.error_shapes)
    pushes = [plant.B @ K @ shape @ (plant.B @ K).T for shape in first]

    def sizes(shapes: list[np.ndarray], power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the largest support of any of the shapes, moved by a matrix, in the rows and at the end."""
        moved = [power @ shape @ power.T for shape in shapes]
        supports = np.sqrt(np.maximum([np.einsum("ij,jk,ik->i", rows, each, rows) for each in moved], 0.0))
        return supports.max(axis=0), np.max([end_sizes(each) for each in moved], axis=0)

    power, summed, summed_end, reach = np.eye(plant.n), np.zeros(len(rows)), np.zeros(()), []
    for _ in range(horizon):
        for shapes in (pushes, [plant.disturbance.shape_matrix]):
            support, at_end = sizes(shapes, power)
            summed, summed_end = summed + support, summed_end + at_end
        power = (plant.A + plant.B @ K) @ power
        support, at_end = sizes(first, power)
        reach.append(summed + support)
    return np.array(reach[:-1]), summed_end + at_end
