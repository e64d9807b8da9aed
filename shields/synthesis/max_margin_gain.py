"""The gain that bears the largest radii: a smooth search over gains, without a semidefinite program."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lu_factor, lu_solve
from scipy.optimize import minimize

from ncs_gym.plants.lqr import regulator_gain
from shields.synthesis.semidefinite_programs import ScaledProblem

# Regulators the search starts from: weight of the inputs, and the rate lx their loops are made to decay with.
EFFORTS = (0.1, 1.0, 10.0, 100.0)
DECAYS = (0.75, 0.9, 0.96, 0.985)
# The most promising ones are pursued.
PURSUED = 3
ITERATIONS = 300
# The logarithm of the need of a gain that does not stabilize, and what keeps logarithms and roots of 0 away.
HOPELESS, TINY = 50.0, 1e-16


@dataclass(frozen=True, eq=False)
class RoomyGain:
    """A gain with the smallest set that is invariant with it.

    Attributes:
        K: Shape (m, n).
        L: Shape (n, n), invariant for the radii given; it satisfies the limits if `reach` is 1 or more.
        shares: lx, le, ld.
        reach: What all radii may grow by before a limit is met.
    """

    K: np.ndarray
    L: np.ndarray
    shares: tuple[float, float, float]
    reach: float


def roomiest_gain(problem: ScaledProblem, Sigma: np.ndarray, *, limited: bool = True) -> RoomyGain | None:
    """Returns the gain that bears the largest radii of disturbance and error sets; None if none is stabilizing.

    For a gain and shares, (I) has a smallest solution L, a Lyapunov series, which grows with the square of the radii;
    so the share of the radii that fits is the smallest ratio of a limit to what L needs of it, and has derivatives.
    The search is local and starts from regulators.

    Args:
        problem: The scaled design problem.
        Sigma: The error set, shape (n, n).
        limited: False drops (U), to find out what binds.
    """
    search = _Search(problem, Sigma, limited)
    with np.errstate(all="ignore"):
        starts = sorted(_starts(problem), key=search.most_needed)[:PURSUED]
        found = [search.improved(start) for start in starts]
    best = min(found, key=lambda one: search.most_needed(one), default=None)
    return None if best is None else search.result(best)


def _starts(problem: ScaledProblem) -> list[np.ndarray]:
    """Returns points (K, logit of lx, logit of le / (1 - lx)) to start from, each of shape (m n + 2,)."""
    gains = [np.zeros((problem.m, problem.n))]
    for effort in EFFORTS:
        for decay in DECAYS:
            gain = regulator_gain(problem.A, problem.B, effort, decay)
            gains += [] if gain is None else [gain]
    points = []
    for gain in gains:
        slowest = float(np.abs(np.linalg.eigvals(problem.A + problem.B @ gain)).max()) ** 2
        if slowest < 1.0:
            lx = 1.0 - 0.7 * (1.0 - slowest)
            points.append(np.append(gain.ravel(), [np.log(lx / (1.0 - lx)), 0.0]))
    return points


class _Search:
    """What a gain needs of the limits, as a function of (K, logit of lx, logit of le / (1 - lx))."""

    def __init__(self, problem: ScaledProblem, Sigma: np.ndarray, limited: bool) -> None:
        self._problem, self._Sigma, self._limited = problem, Sigma, limited

    def most_needed(self, point: np.ndarray) -> float:
        """Returns the logarithm of the largest square need, shape (); at most 0 if every limit is met."""
        return float(self._needs(point)[0].max())

    def improved(self, start: np.ndarray) -> np.ndarray:
        """Returns a point near `start` that needs less, by sequential quadratic programming on t >= needs."""
        slope = np.append(np.zeros(len(start)), 1.0)

        def jacobian(point: np.ndarray) -> np.ndarray:
            slopes = self._needs(point[:-1])[1]
            return np.column_stack([-slopes, np.ones(len(slopes))])

        found = minimize(
            lambda point: point[-1],
            np.append(start, self.most_needed(start)),
            jac=lambda point: slope,
            constraints={"type": "ineq", "fun": lambda point: point[-1] - self._needs(point[:-1])[0], "jac": jacobian},
            method="SLSQP",
            options={"maxiter": ITERATIONS, "ftol": 1e-7},
        ).x[:-1]
        return min((found, start), key=self.most_needed)

    def result(self, point: np.ndarray) -> RoomyGain:
        """Returns the gain of a point with its set."""
        K, lx, part = self._unpacked(point)
        L, _, _ = self._smallest_set(K, lx, part)
        shares = lx, (1.0 - lx) * part, (1.0 - lx) * (1.0 - part)
        return RoomyGain(K=K, L=L, shares=shares, reach=float(np.exp(-0.5 * self.most_needed(point))))

    def _unpacked(self, point: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Returns K, lx and le / (1 - lx)."""
        lx, part = 1.0 / (1.0 + np.exp(-np.clip(point[-2:], -30.0, 30.0)))
        return point[:-2].reshape(self._problem.m, self._problem.n), float(lx), float(part)

    def _smallest_set(self, K: np.ndarray, lx: float, part: float) -> tuple[np.ndarray, np.ndarray, tuple]:
        """Returns L = F L F' + S of (I), F = (A + BK) / sqrt(lx), and the factors of its linear equations."""
        problem, n = self._problem, self._problem.n
        moved = problem.B @ K
        source = moved @ self._Sigma @ moved.T / ((1.0 - lx) * part) + problem.D / ((1.0 - lx) * (1.0 - part))
        F = (problem.A + moved) / np.sqrt(lx)
        factors = lu_factor(np.eye(n * n) - np.kron(F, F), check_finite=False)
        L = lu_solve(factors, source.ravel(), check_finite=False).reshape(n, n)
        return 0.5 * (L + L.T), F, factors

    def _needs(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the logarithms of c_i L c_i' and of (|K_i|_L + |K_i|_Sigma)^2, and their derivatives.

        A functional tr(Z L) changes by tr(Y dS) + 2 tr(Y dF L F') with the adjoint Y = F'YF + Z.
        """
        problem, (K, lx, part) = self._problem, self._unpacked(point)
        C, rows = problem.C, K if self._limited else K[:0]
        unstable = np.full(len(C) + len(rows), HOPELESS), np.zeros((len(C) + len(rows), len(point)))
        if not (np.isfinite(K).all() and np.abs(np.linalg.eigvals(problem.A + problem.B @ K)).max() ** 2 < lx):
            return unstable
        L, F, factors = self._smallest_set(K, lx, part)
        functionals = np.concatenate([C, rows])
        squares = np.einsum("ij,jk,ik->i", functionals, L, functionals) + TINY
        slopes = self._slopes(functionals, K, lx, part, L, F, factors)
        needs, derivatives = np.log(squares), slopes / squares[:, None]
        for i, row in enumerate(rows, start=len(C)):
            slopes[i, :-2].reshape(K.shape)[i - len(C)] += 2.0 * L @ row
            error = np.zeros_like(slopes[i])
            error[:-2].reshape(K.shape)[i - len(C)] = 2.0 * self._Sigma @ row
            a, b = np.sqrt(squares[i]), np.sqrt(row @ self._Sigma @ row + TINY)
            needs[i], derivatives[i] = 2.0 * np.log(a + b), (slopes[i] / a + error / b) / (a + b)
        usable = np.isfinite(needs).all() and np.isfinite(derivatives).all()
        return (needs, derivatives) if usable else unstable

    def _slopes(
        self,
        functionals: np.ndarray,
        K: np.ndarray,
        lx: float,
        part: float,
        L: np.ndarray,
        F: np.ndarray,
        factors: tuple,
    ) -> np.ndarray:
        """Returns the derivatives of z'Lz for fixed z, the rows of `functionals` (k, n), shape (k, m n + 2)."""
        problem, n = self._problem, self._problem.n
        sources = np.einsum("ij,ik->jki", functionals, functionals).reshape(n * n, -1)
        adjoints = lu_solve(factors, sources, trans=1, check_finite=False).T.reshape(-1, n, n)
        adjoints = 0.5 * (adjoints + adjoints.transpose(0, 2, 1))
        le, ld = (1.0 - lx) * part, (1.0 - lx) * (1.0 - part)
        moved = problem.B @ K
        by_gain = 2.0 * problem.B.T @ adjoints @ (moved @ self._Sigma / le + F @ L / np.sqrt(lx))
        by_le = -np.einsum("kij,ij->k", adjoints, moved @ self._Sigma @ moved.T) / le**2
        by_ld = -np.einsum("kij,ij->k", adjoints, problem.D) / ld**2
        by_lx = -np.einsum("kij,ij->k", adjoints, F @ L @ F.T) / lx - part * by_le - (1.0 - part) * by_ld
        by_part = (1.0 - lx) * (by_le - by_ld)
        scalars = np.stack([lx * (1.0 - lx) * by_lx, part * (1.0 - part) * by_part], axis=1)
        return np.concatenate([by_gain.reshape(len(functionals), -1), scalars], axis=1)
