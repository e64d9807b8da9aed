"""The gain that tolerates the largest radii: a smooth search over gains, without a semidefinite program."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import get_lapack_funcs, lu_solve
from scipy.optimize import minimize

from ncs_gym.plants.lqr import regulator_gain
from shields.synthesis.design_problem import DesignProblem

# Weights of the inputs, and decay rates of the closed loop, of the linear-quadratic regulators the search begins with.
_INPUT_WEIGHTS = (0.1, 1.0, 10.0, 100.0)
_DECAY_RATES = (0.75, 0.9, 0.96, 0.985)
# The search is continued from this many of them.
_LOCAL_SEARCHES = 3
_ITERATIONS = 300
# Logarithm of the use of every limit that is assigned to a gain that does not stabilize.
_UNSTABLE_USE = 50.0
# Keeps logarithms and square roots away from 0.
_TINY = 1e-16
# LU factors without a warning for a singular matrix.
_factorize: Any = get_lapack_funcs("getrf")


@dataclass(frozen=True, eq=False)
class MaxMarginGain:
    """A gain with the smallest set that is invariant under it.

    Attributes:
        K: Gain in scaled coordinates, shape (m, n).
        L: Shape of the smallest invariant set for the given radii, (n, n); it respects the limits if `margin` >= 1.
        multipliers: Multipliers (lx, le, ld) with which (I) holds.
        margin: Factor by which all radii of disturbance and error sets may grow before a limit is violated.
    """

    K: np.ndarray
    L: np.ndarray
    multipliers: tuple[float, float, float]
    margin: float


def max_margin_gain(
    problem: DesignProblem, Sigma: np.ndarray, *, searches: int = _LOCAL_SEARCHES
) -> MaxMarginGain | None:
    """Returns the gain that tolerates the largest radii; None if no stabilizing gain is found.

    For a gain and multipliers, (I) has a smallest solution L, a Lyapunov series, which grows with the square of the
    radii. So the tolerated radii are those at which L just uses up the first limit, a function with derivatives. The
    search is local and begins at linear-quadratic regulators.

    Args:
        problem: The scaled design problem.
        Sigma: Shape of the error set, scaled, (n, n).
        searches: Number of regulators, those of largest margin, that the search begins at.
    """
    search = _GainSearch(problem, Sigma)
    initial = sorted(_initial_points(problem), key=search.largest_use)[:searches]
    improved = [search.improved(point) for point in initial]
    best = min(improved, key=search.largest_use, default=None)
    return None if best is None else search.gain_at(best)


def _initial_points(problem: DesignProblem) -> list[np.ndarray]:
    """Returns points (K, logit of lx, logit of le / (1 - lx)) with stabilizing K, each of shape (m n + 2,)."""
    gains = [np.zeros((problem.m, problem.n))]
    for input_weight in _INPUT_WEIGHTS:
        for decay_rate in _DECAY_RATES:
            gain = regulator_gain(problem.A, problem.B, input_weight, decay_rate)
            gains += [] if gain is None else [gain]
    points = []
    for gain in gains:
        slowest = float(np.abs(np.linalg.eigvals(problem.A + problem.B @ gain)).max()) ** 2
        if slowest < 1.0:
            lx = 1.0 - 0.7 * (1.0 - slowest)
            points.append(np.append(gain.ravel(), [np.log(lx / (1.0 - lx)), 0.0]))
    return points


class _GainSearch:
    """How much of each limit a gain uses, as a function of the point (K, logit of lx, logit of le / (1 - lx))."""

    def __init__(self, problem: DesignProblem, Sigma: np.ndarray) -> None:
        self._problem, self._Sigma = problem, Sigma
        self._gain_shape = problem.m, problem.n
        self._last_point, self._last_uses = b"", (np.empty(0), np.empty((0, 0)))

    def largest_use(self, point: np.ndarray) -> float:
        """Returns the logarithm of the squared use of the most used limit; at most 0 if every limit is respected."""
        return float(self._uses(point)[0].max())

    def improved(self, initial: np.ndarray) -> np.ndarray:
        """Returns a point with a smaller largest use, by sequential quadratic programming: minimize t >= uses."""
        objective_slope = np.append(np.zeros(len(initial)), 1.0)

        def jacobian(point: np.ndarray) -> np.ndarray:
            slopes = self._uses(point[:-1])[1]
            return np.column_stack([-slopes, np.ones(len(slopes))])

        local = minimize(
            lambda point: point[-1],
            np.append(initial, self.largest_use(initial)),
            jac=lambda point: objective_slope,
            constraints={"type": "ineq", "fun": lambda point: point[-1] - self._uses(point[:-1])[0], "jac": jacobian},
            method="SLSQP",
            options={"maxiter": _ITERATIONS, "ftol": 1e-7},
        ).x[:-1]
        return min((local, initial), key=self.largest_use)

    def gain_at(self, point: np.ndarray) -> MaxMarginGain:
        """Returns the gain of a point with its invariant set."""
        K, lx, fraction = self._unpacked(point)
        L, _, _ = self._smallest_set(K, lx, fraction)
        multipliers = lx, (1.0 - lx) * fraction, (1.0 - lx) * (1.0 - fraction)
        return MaxMarginGain(K=K, L=L, multipliers=multipliers, margin=float(np.exp(-0.5 * self.largest_use(point))))

    def _unpacked(self, point: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Returns K, lx and the fraction le / (1 - lx)."""
        lx, fraction = 1.0 / (1.0 + np.exp(-np.clip(point[-2:], -30.0, 30.0)))
        return point[:-2].reshape(self._gain_shape), float(lx), float(fraction)

    def _smallest_set(self, K: np.ndarray, lx: float, fraction: float) -> tuple[np.ndarray, np.ndarray, tuple]:
        """Returns L = F L F' + S of (I), F = (A + BK) / sqrt(lx), and the factors of its linear equations."""
        problem, (_, n) = self._problem, self._gain_shape
        BK = problem.B @ K
        source = BK @ self._Sigma @ BK.T / ((1.0 - lx) * fraction) + problem.D_u / ((1.0 - lx) * (1.0 - fraction))
        F = (problem.A + BK) / np.sqrt(lx)
        kronecker = (F[:, None, :, None] * F[None, :, None, :]).reshape(n * n, n * n)
        lu, pivots, _ = _factorize(np.eye(n * n) - kronecker)  # of a singular one L is not finite, and nothing is said
        factors = lu, pivots
        L = lu_solve(factors, source.ravel(), check_finite=False).reshape(n, n)
        return 0.5 * (L + L.T), F, factors

    def _uses(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the logarithms of c_i L c_i' and of (|K_i|_L + |K_i|_Sigma)^2, and their derivatives."""
        if point.tobytes() != self._last_point:  # the search asks for values and derivatives in turn
            self._last_uses, self._last_point = self._computed_uses(point), point.tobytes()
        return self._last_uses

    def _computed_uses(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns what `_uses` does for a new point.

        A functional tr(Z L) changes by tr(Y dS) + 2 tr(Y dF L F') with the adjoint Y = F'YF + Z.
        """
        problem, (K, lx, fraction) = self._problem, self._unpacked(point)
        C, rows = problem.C, K
        unstable = np.full(len(C) + len(rows), _UNSTABLE_USE), np.zeros((len(C) + len(rows), len(point)))
        if not (np.isfinite(K).all() and np.abs(np.linalg.eigvals(problem.A + problem.B @ K)).max() ** 2 < lx):
            return unstable
        L, F, factors = self._smallest_set(K, lx, fraction)
        functionals = np.concatenate([C, rows])
        squares = np.einsum("ij,jk,ik->i", functionals, L, functionals) + _TINY
        slopes = self._slopes(functionals, K, lx, fraction, L, F, factors)
        uses, derivatives = np.log(squares), slopes / squares[:, None]
        for i, row in enumerate(rows, start=len(C)):
            slopes[i, :-2].reshape(K.shape)[i - len(C)] += 2.0 * L @ row
            error = np.zeros_like(slopes[i])
            error[:-2].reshape(K.shape)[i - len(C)] = 2.0 * self._Sigma @ row
            a, b = np.sqrt(squares[i]), np.sqrt(row @ self._Sigma @ row + _TINY)
            uses[i], derivatives[i] = 2.0 * np.log(a + b), (slopes[i] / a + error / b) / (a + b)
        usable = np.isfinite(uses).all() and np.isfinite(derivatives).all()
        return (uses, derivatives) if usable else unstable

    def _slopes(
        self,
        functionals: np.ndarray,
        K: np.ndarray,
        lx: float,
        fraction: float,
        L: np.ndarray,
        F: np.ndarray,
        factors: tuple,
    ) -> np.ndarray:
        """Returns the derivatives of z'Lz for fixed z, the rows of `functionals` (k, n), shape (k, m n + 2)."""
        problem, (_, n) = self._problem, self._gain_shape
        sources = np.einsum("ij,ik->jki", functionals, functionals).reshape(n * n, -1)
        adjoints = lu_solve(factors, sources, trans=1, check_finite=False).T.reshape(-1, n, n)
        adjoints = 0.5 * (adjoints + adjoints.transpose(0, 2, 1))
        le, ld = (1.0 - lx) * fraction, (1.0 - lx) * (1.0 - fraction)
        BK = problem.B @ K
        by_gain = 2.0 * problem.B.T @ adjoints @ (BK @ self._Sigma / le + F @ L / np.sqrt(lx))
        by_le = -np.einsum("kij,ij->k", adjoints, BK @ self._Sigma @ BK.T) / le**2
        by_ld = -np.einsum("kij,ij->k", adjoints, problem.D_u) / ld**2
        by_lx = -np.einsum("kij,ij->k", adjoints, F @ L @ F.T) / lx - fraction * by_le - (1.0 - fraction) * by_ld
        by_fraction = (1.0 - lx) * (by_le - by_ld)
        scalars = np.stack([lx * (1.0 - lx) * by_lx, fraction * (1.0 - fraction) * by_fraction], axis=1)
        return np.concatenate([by_gain.reshape(len(functionals), -1), scalars], axis=1)
