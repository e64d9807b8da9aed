"""A predictive safety filter as people build it: a nominal model predictive program from the estimate."""

from __future__ import annotations

import warnings

import cvxpy as cp
import numpy as np

from ncs_gym import LinearPlant
from shields import Certificate
from shields.verification import require_valid

# Steps that are looked ahead.
HORIZON = 20


class PredictiveFilter:
    """The closest input from which a nominal plan exists that ends in the safe set.

    It solves, with x_0 = x_hat taken for the true state and neither disturbance nor error set,

        min |u_0 - proposed|^2  s.t.  x_{i+1} = A x_i + B u_i,  |u_i| <= u_max,  |c_j x_i| <= 1 (0 < i < N),  x_N in S.

    Where the proposed input followed by u = K x is such a plan already, nothing is solved. Where the program has no
    solution, the rest of the last plan is applied, as the authors do, and u = K x_hat when it is used up.

    Wabersich and Zeilinger: "Linear model predictive safety certification for learning-based control" (2018) and "A
    predictive safety filter for learning-based control of constrained nonlinear dynamical systems" (2021).

    Args:
        certificate: Gives S and K; verified exactly here.
        plant: The plant it was made for.
        horizon: N [steps], at least 2.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
    """

    def __init__(self, certificate: Certificate, plant: LinearPlant, horizon: int = HORIZON) -> None:
        require_valid(certificate, plant)
        self._plant, self._K, self._horizon = plant, certificate.K, horizon
        self._root = np.linalg.cholesky(certificate.M).T
        self._plans = np.empty((0, horizon - 1, plant.m))
        self._estimate, self._proposed = cp.Parameter(plant.n), cp.Parameter(plant.m)
        self._inputs = cp.Variable((horizon, plant.m))
        self._program = self._built()

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
        for _ in range(self._horizon - 1):
            fine &= (np.abs(states @ plant.C.T) <= 1.0).all(axis=1)
            plans.append(self._gained(states))
            states = states @ plant.A.T + plans[-1] @ plant.B.T
        return fine & (np.square(states @ self._root.T).sum(axis=1) <= 1.0), np.stack(plans, axis=1)

    def _solved(self, estimate: np.ndarray, proposed: np.ndarray) -> np.ndarray | None:
        """Returns the inputs of the best plan, shape (horizon, m); None if the solver finds none."""
        plant = self._plant
        missed = np.abs(plant.C @ plant.A @ estimate) - np.abs(plant.C @ plant.B) @ plant.u_max
        if not missed.max() <= 1.0:  # no input brings the next state into the box
            return None
        self._estimate.value, self._proposed.value = estimate, proposed
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # an inaccurate solution is told by the status
                self._program.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return None
        inputs = self._inputs.value
        if self._program.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or inputs is None:
            return None
        return np.clip(inputs, -self._plant.u_max, self._plant.u_max)

    def _built(self) -> cp.Problem:
        """Returns the program, whose parameters are estimate and proposed input."""
        plant, state = self._plant, self._estimate
        constraints: list[cp.Constraint] = [cp.abs(self._inputs) <= plant.u_max[None]]
        for i in range(self._horizon):
            state = plant.A @ state + plant.B @ self._inputs[i]
            inside = cp.norm(self._root @ state) <= 1.0 if i == self._horizon - 1 else cp.abs(plant.C @ state) <= 1.0
            constraints.append(inside)
        return cp.Problem(cp.Minimize(cp.sum_squares(self._inputs[0] - self._proposed)), constraints)

    def _gained(self, states: np.ndarray) -> np.ndarray:
        """Returns u = K x within the limits, shape (m,) or (N, m)."""
        return np.clip(states @ self._K.T, -self._plant.u_max, self._plant.u_max)
