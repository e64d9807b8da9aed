"""The semidefinite programs of the certified synthesis, in coordinates where the box ellipsoid is the unit ball."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import reduce

import cvxpy as cp
import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.uncertainty.ellipsoid import is_inside, joined
from shields.errors import Infeasible
from shields.verification.verify import ACTION_ROUNDING

# No error set in the programs is thinner than this share of its length; exact verification uses the sets themselves.
THINNEST = 0.01
USABLE = (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaledProblem:
    """The design problem in scaled coordinates z = T^-1 x, u / u_max, with T T' the largest ellipsoid in the box.

    Attributes:
        A, B, C: Scaled plant, shapes (n, n), (n, m), (k, n).
        D: D_u, shape (n, n): disturbance plus the rounding of actions.
        Sigmas: Error sets that K x_hat must be safe with, shape (k, n, n).
        transform: T, shape (n, n).
        u_max: Shape (m,).
        growth: s of D_u.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    Sigmas: np.ndarray
    transform: np.ndarray
    u_max: np.ndarray
    growth: float

    @property
    def critical(self) -> np.ndarray:
        """The error sets that lie in no other, slightly thickened where they are very flat, shape (l, n, n).

        Linearizing L Sigma^-1 L leaves L no room to move if Sigma is almost flat; a larger set is a sound one.
        """
        kept = list(self.Sigmas)
        for Sigma in self.Sigmas:
            others = [other for other in kept if other is not Sigma]
            if any(is_inside(Sigma, other) for other in others):
                kept = others
        longest = np.linalg.eigvalsh(np.stack(kept))[:, -1]
        return np.stack(kept) + THINNEST**2 * longest[:, None, None] * np.eye(self.n)

    @property
    def covering(self) -> np.ndarray:
        """An error set around all of them, shape (n, n)."""
        return reduce(joined, self.Sigmas)

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def m(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]

    def physical(self, L: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns L and K in physical units."""
        shape = self.transform @ L @ self.transform.T
        return 0.5 * (shape + shape.T), np.diag(self.u_max) @ np.linalg.solve(self.transform.T, K.T).T


@dataclass(frozen=True, eq=False)
class Design:
    """A candidate in scaled coordinates: L (n, n), K (m, n), its shares and log det L."""

    L: np.ndarray
    K: np.ndarray
    shares: tuple[float, float, float]
    inputs: np.ndarray
    log_det: float


def scaled_problem(plant: LinearPlant, Sigmas: np.ndarray, box: np.ndarray) -> ScaledProblem:
    """Returns the design problem for error sets (k, n, n) and the largest ellipsoid in the box (n, n)."""
    T = np.linalg.cholesky(box)
    D = plant.disturbance.shape
    step = plant.B * (float(ACTION_ROUNDING) * plant.u_max)
    rounding = plant.m * step @ step.T
    weight = np.linalg.inv(box)
    ratio = np.vdot(weight, rounding) / max(float(np.vdot(weight, D)), 1e-30)
    growth = float(np.sqrt(np.clip(ratio, 1e-16, 1.0)))
    inverse = np.linalg.inv(T)
    D_u = (1.0 + growth) * D + (1.0 + 1.0 / growth) * rounding
    return ScaledProblem(
        A=inverse @ plant.A @ T,
        B=inverse @ plant.B @ np.diag(plant.u_max),
        C=plant.C @ T,
        D=inverse @ D_u @ inverse.T,
        Sigmas=inverse @ Sigmas @ inverse.T,
        transform=T,
        u_max=plant.u_max,
        growth=growth,
    )


def largest_box_ellipsoid(C: np.ndarray) -> np.ndarray:
    """Returns the shape of the largest ellipsoid in {|c_j x| <= 1}, (n, n), for C (k, n) of full column rank.

    Raises:
        Infeasible: If the solver fails.
    """
    k, n = C.shape
    if k == n:
        inverse = np.linalg.inv(C)
        return inverse @ inverse.T
    scale = np.linalg.cholesky(np.linalg.inv(C.T @ C))
    L = cp.Variable((n, n), symmetric=True)
    problem = cp.Problem(cp.Maximize(cp.log_det(L)), [cp.diag((C @ scale) @ L @ (C @ scale).T) <= 1])
    if not _solve(problem):
        raise Infeasible("the solver did not find the largest ellipsoid in the safe box", "S", float("nan"))
    return scale @ found(L) @ scale.T


class InvariantSetProgram:
    """Maximizes log det L over (L, K) for fixed shares, with X <= L Sigma^-1 L linearized at a given L0.

    With F = K L the conditions (I), (U), (S) of theory.md section 3 are linear matrix inequalities. The problem is
    canonicalized once; shares and linearization are parameters.

    Args:
        problem: The scaled design problem.
        slack: Relative growth of every disturbance and shrinkage of every limit, the room that exact
            verification needs.
    """

    def __init__(self, problem: ScaledProblem, slack: float) -> None:
        n, m = problem.n, problem.m
        self.problem, self.slack = problem, slack
        self._roots = list(np.linalg.cholesky((1.0 + slack) * problem.critical))
        self._L, self._F = cp.Variable((n, n), symmetric=True), cp.Variable((m, n))
        self._state, self._mu = cp.Parameter(nonneg=True), cp.Parameter(m, nonneg=True)
        self._D = cp.Parameter((n, n), symmetric=True)
        # The blocks le X and (1 - mu_i) X, in coordinates where Sigma is the identity (else its smallness spoils the
        # solver's accuracy); each has parameters of its own, because products of parameters are not allowed.
        self._slopes = [[cp.Parameter((n, n)) for _ in range(m + 1)] for _ in self._roots]
        self._offsets = [[cp.Parameter((n, n), symmetric=True) for _ in range(m + 1)] for _ in self._roots]
        self._program = cp.Problem(cp.Maximize(cp.log_det(self._L)), self._constraints())

    def _constraints(self) -> list[cp.Constraint]:
        """Returns (S), and (I) and (U) for every critical error set, as linear matrix inequalities."""
        problem, L = self.problem, self._L
        constraints: list[cp.Constraint] = [cp.diag(problem.C @ L @ problem.C.T) <= 1.0 - self.slack]
        for root, slopes, offsets in zip(self._roots, self._slopes, self._offsets, strict=True):
            X = [
                root.T @ L @ slope + slope.T @ L @ root - offset for slope, offset in zip(slopes, offsets, strict=True)
            ]
            constraints += self._for_one_set(root, X)
        return constraints

    def _for_one_set(self, root: np.ndarray, X: list[cp.Expression]) -> list[cp.Constraint]:
        """Returns (I) and (U) for the error set E(root root'), with le X and (1 - mu_i) X in its coordinates."""
        problem, L, F = self.problem, self._L, self._F
        zero = np.zeros((problem.n, problem.n))
        moved, gain = problem.A @ L + problem.B @ F, problem.B @ F @ root
        constraints: list[cp.Constraint] = [
            cp.bmat([[L - self._D, moved, gain], [moved.T, self._state * L, zero], [gain.T, zero, X[0]]]) >> 0
        ]
        corner = np.array([[1.0 - self.slack - 2.0 * float(ACTION_ROUNDING)]])
        for i in range(problem.m):
            row = F[i : i + 1, :]
            blocks = [[corner, row, row @ root], [row.T, self._mu[i] * L, zero], [(row @ root).T, zero, X[i + 1]]]
            constraints.append(cp.bmat(blocks) >> 0)
        return constraints

    def solve(
        self,
        shares: tuple[float, float, float],
        inputs: np.ndarray,
        linearize_at: np.ndarray,
    ) -> Design | None:
        """Returns the best design for shares (lx, le, ld) and mu, shape (m,); None if there is none.

        Args:
            shares: lx, le, ld > 0 that sum to 1.
            inputs: mu_i in (0, 1).
            linearize_at: L0, shape (n, n).
        """
        lx, le, ld = shares
        self._state.value = lx * (1.0 - self.slack)
        self._D.value = self.problem.D * ((1.0 + self.slack) / ld)
        self._mu.value = inputs
        # With Sigma = G G' the linearized G'XG is G'L (Sigma^-1 L0 G) + its transpose - (G^-1 L0 G)'(G^-1 L0 G).
        for root, slopes, offsets in zip(self._roots, self._slopes, self._offsets, strict=True):
            inner = np.linalg.solve(root, linearize_at @ root)
            slope, offset = np.linalg.solve(root.T, inner), inner.T @ inner
            for share, P, R in zip((le, *(1.0 - inputs)), slopes, offsets, strict=True):
                P.value, R.value = share * slope, 0.5 * share * (offset + offset.T)
        if not _solve(self._program):
            return None
        L, F = found(self._L), found(self._F)
        L = 0.5 * (L + L.T)
        sign, log_det = np.linalg.slogdet(L)
        if sign <= 0 or np.linalg.eigvalsh(L)[0] <= 0.0:
            return None
        return Design(L, np.linalg.solve(L, F.T).T, shares, inputs, float(log_det))


def best_gain(problem: ScaledProblem, design: Design) -> np.ndarray:
    """Returns the gain, shape (m, n), that leaves (I) the most room for the design's L; its own if none is better."""
    n, m = problem.n, problem.m
    L, (lx, le, ld), identity = design.L, design.shares, np.eye(problem.n)
    K, room = cp.Variable((m, n)), cp.Variable()
    zero = np.zeros((n, n))
    moved = (problem.A + problem.B @ K) @ L
    corner = np.array([[1.0 - 4.0 * float(ACTION_ROUNDING)]])
    constraints = []
    for root in np.linalg.cholesky(problem.critical):
        gain = problem.B @ K @ root
        blocks = [[room * L - problem.D / ld, moved, gain], [moved.T, lx * L, zero], [gain.T, zero, le * identity]]
        constraints.append(cp.bmat(blocks) >> 0)
        for i, mu in enumerate(design.inputs):
            row, err = K[i : i + 1, :] @ L, K[i : i + 1, :] @ root
            blocks = [[corner, row, err], [row.T, mu * L, zero], [err.T, zero, (1.0 - mu) * identity]]
            constraints.append(cp.bmat(blocks) >> 0)
    if not _solve(cp.Problem(cp.Minimize(room), constraints)):
        return design.K
    return found(K)


def found(variable: cp.Variable) -> np.ndarray:
    """Returns the value that a solver found for a variable.

    Raises:
        ValueError: If it found none.
    """
    if variable.value is None:
        raise ValueError(f"the solver found no value of {variable}")
    return variable.value


def _solve(program: cp.Problem) -> bool:
    """Returns whether the solver found finite numbers to work with; exact verification judges them later."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "solution may be inaccurate": verified exactly afterwards
            program.solve(solver=cp.CLARABEL)
    except (cp.SolverError, ArithmeticError, ValueError):
        return False
    if program.status not in USABLE:
        return False
    return all(variable.value is not None and np.isfinite(variable.value).all() for variable in program.variables())
