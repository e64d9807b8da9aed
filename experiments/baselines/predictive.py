"""A predictive safety filter as people build it: a nominal model predictive program from the estimate."""

from __future__ import annotations

import numpy as np

from ncs_gym import LinearPlant
from shields import Certificate
from shields.runtime.backup_plans.plan_check import Prediction
from shields.runtime.backup_plans.program import PlanProgram
from shields.runtime.one_step import OneStepTest
from shields.verification import require_valid

# Steps that are looked ahead; a tube leaves no room for more than a few.
HORIZON, TUBE_HORIZON = 20, 3
# A solution may miss the limits of box and safe set by this much, as solvers do.
TOLERANCE = 1e-6


class PredictiveFilter:
    """The closest input from which a nominal plan exists that ends in the safe set.

    It solves, with x_0 = x_hat taken for the true state and neither disturbance nor error set,

        min |u_0 - proposed|^2  s.t.  x_{i+1} = A x_i + B u_i,  |u_i| <= u_max,
                                      |c_j x_i| <= 1 - t_ij (0 < i < N),  |x_N|_M <= 1 - t_N.

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
        self._root = np.linalg.cholesky(certificate.M).T
        self._plans = np.empty((0, horizon - 1, plant.m))
        self._prediction = Prediction(OneStepTest(certificate.L, plant), horizon)
        self._program = PlanProgram(self._prediction)
        self._room, self._radius = np.full((horizon - 1, len(plant.box_rows)), 1.0 - margin), 1.0 - margin
        if tube:
            reach, end = _tube(certificate, plant, self._root, horizon)
            self._room, self._radius = self._room - reach, self._radius - end
        self._room_and_end = np.vstack([self._room, np.ones(self._room.shape[1])])  # its last row is for ends in P
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
        return fine & (np.linalg.norm(states @ self._root.T, axis=1) <= self._radius), np.stack(plans, axis=1)

    def _solved(self, estimate: np.ndarray, proposed: np.ndarray) -> np.ndarray | None:
        """Returns the inputs of the best plan, shape (horizon, m); None if the solver finds none."""
        plant = self._plant
        missed = np.abs(plant.box_rows @ plant.A @ estimate) - np.abs(plant.box_rows @ plant.B) @ plant.u_max
        if not (missed <= self._room[0]).all() or self._radius <= 0.0:  # no input brings the next state into the box
            return None
        plan = self._program.solve(estimate, self._room_and_end, self._root, self._radius, self._between, proposed)
        if plan is None:
            return None
        plan = np.clip(plan, -plant.u_max, plant.u_max)
        centers = self._prediction.centers(estimate[None], plan[None, None])[..., 0, 0]
        inside = (np.abs(centers[:-1] @ plant.box_rows.T) <= self._room + TOLERANCE).all()
        return plan if inside and np.linalg.norm(self._root @ centers[-1]) <= self._radius + TOLERANCE else None

    def _gained(self, states: np.ndarray) -> np.ndarray:
        """Returns u = K x within the limits, shape (m,) or (N, m)."""
        return np.clip(states @ self._K.T, -self._plant.u_max, self._plant.u_max)


def _tube(certificate: Certificate, plant: LinearPlant, root: np.ndarray, horizon: int) -> tuple[np.ndarray, float]:
    """Returns how far true states are off a plan in the rows of the box, shape (N - 1, k), and at its end in S.

    Args:
        certificate: Gives the error sets and K.
        plant: The plant.
        root: G with |G x| = |x|_M.
        horizon: N.
    """
    K, rows = certificate.K, plant.box_rows
    first = list(certificate.error_shapes)
    pushes = [plant.B @ K @ shape @ (plant.B @ K).T for shape in first]

    def size(shapes: list[np.ndarray], power: np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the largest support of any of the shapes, moved by a matrix, in the rows and in the norm of S."""
        moved = [power @ shape @ power.T for shape in shapes]
        supports = np.sqrt(np.maximum([np.einsum("ij,jk,ik->i", rows, each, rows) for each in moved], 0.0))
        return supports.max(axis=0), np.sqrt(max(np.linalg.eigvalsh(root @ each @ root.T)[-1] for each in moved))

    power, summed, summed_end, reach, end = np.eye(plant.n), np.zeros(len(rows)), 0.0, [], 0.0
    for _ in range(horizon):
        for shapes in (pushes, [plant.disturbance.shape_matrix]):
            support, norm = size(shapes, power)
            summed, summed_end = summed + support, summed_end + norm
        power = (plant.A + plant.B @ K) @ power
        support, norm = size(first, power)
        reach.append(summed + support)
        end = summed_end + norm
    return np.array(reach[:-1]), end
