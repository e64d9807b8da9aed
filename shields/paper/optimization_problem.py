"""The published optimization problem OP (Liu et al. Definition 4), as printed."""

from __future__ import annotations

from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from ncs_gym import LinearPlant
from shields.paper.bounds import PaperBounds
from shields.synthesis.semidefinite_programs import is_solved, largest_box_ellipsoid, value_of


@dataclass(frozen=True, eq=False)
class OPSolution:
    """A solution of OP.

    Attributes:
        L: Shape of the safe set, (n, n).
        K: Gain, shape (m, n) [input per state].
        bounds: kappa, rho and the constants of OP at them.
        log_det: Logarithm of det L.
    """

    L: np.ndarray
    K: np.ndarray
    bounds: PaperBounds
    log_det: float


@dataclass(frozen=True, eq=False)
class NormalizedPlant:
    """The plant in units in which the safe box is of size 1 and every input is limited by 1.

    All states share one unit, so that OP's identity matrices stay what they are: with x = size x', L = size^2 L', and
    alpha, eps and eps_up are divided by size^2.

    Attributes:
        A: State matrix, shape (n, n).
        B: Input matrix in these units, shape (n, m).
        C: Rows of the safe box in these units, shape (k, n).
        size: Unit of the states.
        u_max: Units of the inputs, shape (m,).
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    size: float
    u_max: np.ndarray

    @classmethod
    def of(cls, plant: LinearPlant) -> NormalizedPlant:
        """Returns a plant with bounded safe box in these units."""
        size = float(np.linalg.det(largest_box_ellipsoid(plant.C))) ** (0.5 / plant.n)
        return cls(plant.A, plant.B * plant.u_max / size, plant.C * size, size, plant.u_max)


def solve_op(plant: LinearPlant, bounds: PaperBounds, *, slack: float = 0.0) -> OPSolution | None:
    """Returns the solution of OP at one (kappa, rho); None if the solver finds none.

    Args:
        plant: The plant.
        bounds: kappa, rho and the constants of OP at them.
        slack: Relative tightening of the constraints.
    """
    n, m, unit = plant.n, plant.m, NormalizedPlant.of(plant)
    alpha, epsilon_up = bounds.alpha / unit.size**2, bounds.epsilon_up / unit.size**2
    L, U = cp.Variable((n, n), symmetric=True), cp.Variable((n, n), symmetric=True)
    F, tau, beta = cp.Variable((m, n)), cp.Variable(m), cp.Variable()
    identity, closed_loop = np.eye(n), unit.A @ L + unit.B @ F
    less, more = 1.0 - slack, 1.0 + slack
    constraints = [
        cp.bmat([[less * bounds.kappa * L, closed_loop.T], [closed_loop, L]]) >> 0,  # (C1)
        L >> more * alpha * identity,  # (C2)
        cp.diag(unit.C @ L @ unit.C.T) <= less,  # (C3)
        epsilon_up * U << less * alpha**2 * identity,  # (C4)
        U >> 0,
    ]
    if bounds.rho == 1.0:
        constraints.append(beta * identity == L)  # (C7)
    else:
        constraints += [more * beta * identity << L, L << less * bounds.rho * beta * identity]
    for i in range(m):
        row = F[i : i + 1, :]
        constraints += [
            cp.bmat([[cp.reshape(less * 0.5 - tau[i], (1, 1), order="C"), row], [row.T, L]]) >> 0,  # (C5), u_max = 1
            cp.bmat([[cp.reshape(tau[i], (1, 1), order="C"), row], [row.T, U]]) >> 0,  # (C6)
        ]
    if not is_solved(cp.Problem(cp.Maximize(cp.log_det(L)), constraints)):
        return None
    shape = 0.5 * (value_of(L) + value_of(L).T)
    if bounds.rho == 1.0:
        shape = float(shape[0, 0]) * identity
    if np.linalg.eigvalsh(shape)[0] <= 0.0:
        return None
    K = unit.u_max[:, None] * np.linalg.solve(shape, value_of(F).T).T / unit.size
    shape = unit.size**2 * shape
    return OPSolution(shape, K, bounds, float(np.linalg.slogdet(shape)[1]))
