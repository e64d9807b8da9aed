"""What radii of disturbances and errors a gain bears, with a polytope or an ellipsoid, and which gain bears most."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgWarning, solve_discrete_lyapunov
from scipy.optimize import minimize

from ncs_gym import ChannelContract, LinearPlant, exact
from ncs_gym.plants.lqr import lqr_gain
from shields.errors import Infeasible
from shields.synthesis.design_problem import DesignProblem, Rest, design_problem
from shields.synthesis.resting_point import (
    around,
    at_operating_point,
    disturbance_around,
    equilibria,
    farthest_equilibrium,
    limit_rows,
    limits_around,
    needs_resting_point,
)

# Weights of the inputs, in units of their limits, against those of the states, in units of the box, in the
# linear-quadratic regulators.
_INPUT_WEIGHTS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
# Disturbances and errors are summed over so many steps that what is left is smaller than this, next to the first ones.
_LEFT_OVER = 1e-7
# They are summed over at most so many steps, and so many numbers. A gain is too slow if more than this is left then.
_MOST_STEPS, _MOST_NUMBERS, _MOST_LEFT = 20_000, 4_000_000, 1e-4
# No limit counts as less needed than this, in units of half its range.
_SMALLEST_NEED = 1e-3
# The search for a more tolerant gain ends after so many iterations, or where one gains less than this.
_ITERATIONS, _SMALLEST_GAIN = 60, 1e-6
# Digits of a tolerated factor.
_DIGITS = 9
# Largest eigenvalues of regulators that stand for one that is too slow, as where a limit stands for none.
_FASTER = (0.95, 0.999)
# What a gain that is too slow is said to lack of every limit.
_TOO_SLOW = -1e3
# Exact verification needs a margin a little above 1.
SUFFICIENT_MARGIN = 1.0 + 1e-5
# Multipliers of an ellipsoid are sought by so many evaluations; their logits are at most so large.
_EVALUATIONS, _LARGEST_LOGIT = 100, 12.0


def regulators(plant: LinearPlant, decay: float = 1.0) -> list[np.ndarray]:
    """Returns gains, (m, n), of linear-quadratic regulators with eigenvalues up to `decay` and less and less input.

    Limits of states and inputs together cost as inputs do.
    """
    A, B = plant.A / decay, plant.B / decay
    state, pushed = plant.mixed_rows[:, : plant.n], plant.mixed_rows[:, plant.n :]
    effort, crossed = np.diag(plant.input_half**-2.0) + pushed.T @ pushed, state.T @ pushed
    found = (
        lqr_gain(A, B, plant.weight + weight * state.T @ state, weight * effort, weight * crossed)
        for weight in _INPUT_WEIGHTS
    )
    return [K for K in found if K is not None]


class Tolerated(NamedTuple):
    """A gain, shape (m, n), and the margin that all radii may grow by until it keeps no polytope within the limits.

    The limits that bind are reached first, numbers of `limit_rows`.
    """

    K: np.ndarray
    rest: Rest
    margin: float
    binding: tuple[int, ...] = ()


class Tolerance:
    """What radii a gain bears.

    From rest errors and disturbances take a limited quantity c x as far as the sum of their supports along the rows
    that the closed loop makes of c, step by step. Where that stays within all limits, the states that stay in them for
    ever are a set around the resting point (Kolmanovsky and Gilbert 1998, docs/bibliography.md), else none is. The
    resting point is the operating point where limits are symmetric, else the one that suits each gain.

    Errors are of the shapes (l, n, n), disturbances of the shape D, (n, n).
    """

    def __init__(self, plant: LinearPlant, errors: np.ndarray, D: np.ndarray) -> None:
        self._plant, self._fixed = plant, None if needs_resting_point(plant) else at_operating_point(plant)
        self._x, self._u = plant.half_widths, plant.input_half
        self._A, self._B = plant.A * self._x / self._x[:, None], plant.B * self._u / self._x[:, None]
        self._errors, self._D = errors / np.outer(self._x, self._x), D / np.outer(self._x, self._x)
        limits, q = limit_rows(plant), len(plant.mixed_rows)
        times = (len(plant.step_rows) - q) // len(plant.box)
        # Of what is not left of the box between samples this part is one of the radii.
        self._arriving = np.concatenate([plant.arriving, np.zeros(plant.m + q), np.tile(plant.arriving, times)])
        self._limits = limits._replace(low=limits.low - self._arriving, high=limits.high + self._arriving)
        self._state, self._input = self._limits.rows[:, : plant.n] * self._x, self._limits.rows[:, plant.n :] * self._u

    def of(self, K: np.ndarray) -> Tolerated | None:
        """Returns what a gain, shape (m, n), bears; None if it is too slow to tell."""
        found = self._needs_and_slopes(self._scaled(K), slopes=False)
        return None if found is None else self._around(K, found[0])

    def improved(self, K: np.ndarray) -> Tolerated | None:
        """Returns the gain of the largest margin near a given one, by sequential quadratic programming.

        None if the given one, shape (m, n), is too slow. The inverse 1 / s of the margin is minimized, the resting
        point x_c is a variable, too: what a gain needs, and x_c / s, stay within the limits times 1 / s.
        """
        best = self.of(K)
        if best is None:
            return None
        shape, limits, fixed = K.shape, self._limits, self._fixed
        largest = np.abs(self._scaled(K)).max(axis=0)  # of each state; so units and wide limits do not matter
        sizes = np.where(largest > 0.0, largest, 1.0)
        directions = np.empty((sum(shape), 0)) if fixed else equilibria(self._plant)
        moved = limits.rows @ directions
        ends = limits if fixed is None else around(limits, fixed)
        above, below = np.isfinite(ends.high), np.isfinite(ends.low)
        last: dict[bytes, tuple[np.ndarray, np.ndarray] | None] = {}

        def lacks(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            k = K.size
            if (key := z[:k].tobytes()) not in last:  # values and derivatives are asked for in turn
                last.clear()
                last[key] = self._needs_and_slopes(z[:k].reshape(shape) * sizes)
            if (found := last[key]) is None:
                return np.full(above.sum() + below.sum(), _TOO_SLOW), np.zeros((above.sum() + below.sum(), len(z)))
            needs, slopes = found[0], (found[1] * sizes).reshape(len(moved), k)
            reached = moved @ z[k:-1]
            left = np.concatenate(
                [(ends.high * z[-1] - reached - needs)[above], (reached - ends.low * z[-1] - needs)[below]]
            )
            by_limit = (
                np.hstack([-slopes, -moved, ends.high[:, None]])[above],
                np.hstack([-slopes, moved, -ends.low[:, None]])[below],
            )
            return left, np.concatenate(by_limit)

        def stop(z: np.ndarray) -> None:
            nonlocal best
            tried = self.of(z[: K.size].reshape(shape) * sizes / self._x * self._u[:, None])
            if tried is not None and best is not None and tried.margin > best.margin:
                best = tried

        units = np.concatenate([self._x, self._u])
        at = np.linalg.lstsq(directions / units[:, None], np.concatenate(best.rest) / units, rcond=None)[0]
        slope = np.append(np.zeros(K.size + len(at)), 1.0)
        minimize(
            lambda z: z[-1],
            np.concatenate([(self._scaled(K) / sizes).ravel(), at / best.margin, [1.0 / best.margin]]),
            jac=lambda z: slope,
            constraints={"type": "ineq", "fun": lambda z: lacks(z)[0], "jac": lambda z: lacks(z)[1]},
            method="SLSQP",
            callback=stop,
            options={"maxiter": _ITERATIONS, "ftol": _SMALLEST_GAIN},
        )
        return best

    def _around(self, K: np.ndarray, needs: np.ndarray) -> Tolerated | None:
        if self._fixed is not None:
            ends = around(self._limits, self._fixed)
            shares = np.minimum(ends.high, -ends.low) / needs
            margin = float(exact.rounded(float(shares.min()), _DIGITS))
            return Tolerated(K, self._fixed, margin, tuple(np.flatnonzero(shares <= margin * (1.0 + 1e-6)).tolist()))
        try:
            farthest = farthest_equilibrium(self._plant, needs, self._limits)
        except Infeasible:  # between samples nothing is left
            return None
        margin = float(exact.rounded(farthest.distance, _DIGITS))
        return Tolerated(K, farthest.rest, margin, tuple(farthest.binding.tolist()))

    def _scaled(self, K: np.ndarray) -> np.ndarray:
        return K * self._x / self._u[:, None]

    def _needs_and_slopes(self, K: np.ndarray, *, slopes: bool = True) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns how far errors and disturbances take every limit from rest under a scaled gain, in half ranges, (r,).

        With the derivatives, (r, m, n), if they are asked for. None if the gain is too slow to tell.
        """
        closed_loop, answer = self._A + self._B @ K, self._B @ K
        first = self._state + self._input @ K
        radius = float(np.abs(np.linalg.eigvals(closed_loop)).max()) if np.isfinite(closed_loop).all() else np.inf
        most = min(_MOST_STEPS, _MOST_NUMBERS // first.size)
        if radius >= 1.0 or most * np.log(max(radius, 1e-3)) > np.log(_MOST_LEFT):
            return None
        steps = min(most, int(np.log(_LEFT_OVER) / np.log(max(radius, 1e-3))) + len(K.T) + 1)
        powers = np.eye(len(closed_loop))[None]
        while len(powers) < steps:
            powers = np.concatenate([powers, powers @ (powers[-1] @ closed_loop)])
        rows = first @ powers[:steps]  # (steps, r, n): c (A + B K)^i
        by_disturbance, to_disturbance = _support(rows, self._D[None])
        by_errors, to_errors = _support(rows @ answer, self._errors)
        at_once, to_input = _support(self._input @ K, self._errors)
        needs = by_disturbance.sum(axis=0) + by_errors.sum(axis=0) + at_once + self._arriving
        needs = np.maximum(needs, _SMALLEST_NEED)
        if not slopes:
            return needs, np.empty((0, *K.shape))
        # The chain rule, backwards: what a row of one step adds to all later ones.
        to_rows, later = to_disturbance + to_errors @ answer.T, np.zeros_like(first)
        summed = np.empty_like(rows)
        for i in range(steps - 1, -1, -1):
            summed[i] = later = to_rows[i] + later @ closed_loop.T
        by_loop = np.einsum("tri,trj->rij", rows[:-1], summed[1:])
        by_answer = np.einsum("tri,trj->rij", rows, to_errors)
        by_input = self._input[:, :, None] * (summed[0] + to_input)[:, None, :]
        return needs, self._B.T @ (by_loop + by_answer) + by_input


def _support(rows: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the largest support over ellipsoids, shape (l, n, n), of rows (..., n), and its derivatives (..., n)."""
    best, slopes = np.zeros(rows.shape[:-1]), np.zeros_like(rows)
    for shape in shapes:
        image = rows @ shape
        support = np.sqrt(np.maximum((image * rows).sum(axis=-1), 0.0))
        larger = support > best
        slopes = np.where(larger[..., None], image / np.where(larger, support, 1.0)[..., None], slopes)
        best = np.where(larger, support, best)
    return best, slopes


class InvariantEllipsoid(NamedTuple):
    """The smallest ellipsoid E(L), (n, n), that is invariant under a gain, (m, n), in scaled coordinates.

    Its multipliers are (lx, le, ld) of (I), its margin the factor that all radii may grow by before it breaks a limit.
    """

    K: np.ndarray
    L: np.ndarray
    multipliers: tuple[float, float, float]
    margin: float


def invariant_ellipsoid(problem: DesignProblem, K: np.ndarray) -> InvariantEllipsoid | None:
    """Returns the invariant ellipsoid of the gain K, shape (m, n), that bears the most; None if K does not stabilize.

    For given multipliers (I) has a smallest solution, a Lyapunov series, which grows with the squares of the radii.
    """
    K = (K @ problem.transform) / problem.u_max[:, None]
    BK, Sigma = problem.B @ K, problem.covering_error_shape
    closed_loop, from_errors = problem.A + BK, BK @ Sigma @ BK.T
    at_once = np.sqrt(np.maximum(((K @ Sigma) * K).sum(axis=1), 0.0))
    slowest = float(np.abs(np.linalg.eigvals(closed_loop)).max()) ** 2
    if not slowest < 1.0:
        return None

    def at(logits: np.ndarray) -> InvariantEllipsoid:
        above, fraction = 1.0 / (1.0 + np.exp(-np.clip(logits, -_LARGEST_LOGIT, _LARGEST_LOGIT)))
        lx = float(slowest + (1.0 - slowest) * above)
        le, ld = float((1.0 - lx) * fraction), float((1.0 - lx) * (1.0 - fraction))
        try:
            L = solve_discrete_lyapunov(closed_loop / np.sqrt(lx), from_errors / le + problem.D_u / ld)
        except np.linalg.LinAlgError:
            L = np.full_like(closed_loop, np.inf)
        by_state = [np.sqrt(np.maximum(((rows @ L) * rows).sum(axis=1), 0.0)) for rows in (problem.C, K)]
        used = float(np.concatenate([by_state[0], by_state[1] + at_once]).max())
        return InvariantEllipsoid(K, 0.5 * (L + L.T), (lx, le, ld), 1.0 / used if used > 0.0 else 0.0)

    options = {"maxfev": _EVALUATIONS, "xatol": 1e-3, "fatol": 1e-6}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LinAlgWarning)  # what is solved badly is verified exactly afterwards
        best = minimize(lambda logits: -at(logits).margin, np.array([-1.0, 0.0]), method="Nelder-Mead", options=options)
        return at(np.round(best.x, _DIGITS))


def tolerated_gains(plant: LinearPlant, contract: ChannelContract | None) -> list[Tolerated]:
    """Returns the most tolerant gain and regulators; raises Infeasible without an error set or a resting point."""
    rest = farthest_equilibrium(plant).rest if needs_resting_point(plant) else at_operating_point(plant)
    _, errors = design_problem(plant, contract, limits_around(plant, rest))
    tolerance = Tolerance(plant, errors.promised, disturbance_around(plant, rest))
    gains = []
    # What no input moves may be slower than those that are faster: of these there may be none.
    for K, *faster in zip_longest(regulators(plant), *(regulators(plant, each) for each in _FASTER)):
        others = [found for each in faster if each is not None and (found := tolerance.of(each))]
        found = (None if K is None else tolerance.of(K)) or most_tolerant(others)
        gains += [] if found is None else [found]
    best = most_tolerant(gains)
    return gains if best is None else [*filter(None, [tolerance.improved(best.K)]), *gains]


def most_tolerant(gains: Sequence[Tolerated]) -> Tolerated | None:
    """Returns the gain that bears most; None of none."""
    return max(gains, key=lambda each: each.margin, default=None)


def most_tolerated(plant: LinearPlant, contract: ChannelContract | None, *, polytope: bool) -> Tolerated | None:
    """Returns the gain that bears the most with a polytope, or else an ellipsoid; None if none stabilizes."""
    gains = tolerated_gains(plant, contract)
    if not polytope:
        problem, _ = design_problem(plant, contract)
        pairs = [(each, invariant_ellipsoid(problem, each.K)) for each in gains]
        # Between samples an ellipsoid bears no more than a polytope.
        gains = [each._replace(margin=min(each.margin, found.margin)) for each, found in pairs if found is not None]
    return most_tolerant(gains)
