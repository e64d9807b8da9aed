"""The largest polytope that the certified gain keeps in the safe box (docs/shield_proof.md, "Polytopes").

It begins with the rows of the box and of the input limits. For every row g with |g x| <= 1, the states after one step
fulfil it if |g (A+BK) x| <= 1 - s - d, where s and d are the supports of the estimation error and of the disturbance:
that is a row again. What a linear program shows to hold already is not added. A+BK is stable, so this comes to an end.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.stats import qmc

from ncs_gym import LinearPlant, exact
from ncs_gym.plants.linear_plant import inputs_under_way
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.polytope import MOST_ROWS, Polytope
from shields.synthesis.design_problem import left_between_samples
from shields.verification import ACTION_ROUNDING

# The search takes at most so long [s], of its thread's own time: what else a machine does decides no certificate.
LONGEST_SEARCH = 60.0
# What the next states keep from every face, relative to the polytope: room for the rounding of rows and multipliers.
_MARGIN = 1e-6
# A row counts as implied by others up to this: a thousandth of the margin.
_IMPLIED = 1e-9
# Where fewer rows than this share of the most are left of a search that has too many, it goes on.
_LEAST_PRUNED = 0.9
# Significant digits of rows and multipliers; what a row lacks by that is far below the margin.
_DIGITS = 10
# The solver's own tolerances, next to units of 1.
_SOLVER = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
# Points at which the share of the box is counted: the third digit is right.
_POINTS_LOG2 = 16
# Steps after which it must be known which points a gain keeps in the box.
_MOST_STEPS = 3000


class Feedback(NamedTuple):
    """The fallback u = K x_hat with what disturbs it.

    Attributes:
        K: The gain, shape (m, n).
        errors: Shapes of the sets of the estimation error, (l, n, n).
        D: Shape of the disturbance set, (n, n).
    """

    K: np.ndarray
    errors: np.ndarray
    D: np.ndarray


def feedback_of(certificate: Certificate) -> Feedback:
    """Returns the fallback of a certificate."""
    return Feedback(certificate.K, certificate.error_shapes, certificate.D)


def invariant_polytope(feedback: Feedback, plant: LinearPlant, progress: Callable[[str], object]) -> Polytope:
    """Returns the largest polytope that a fallback keeps invariant, not yet verified.

    Args:
        feedback: The fallback.
        plant: Its plant.
        progress: Called with a line of text now and then.

    Raises:
        Infeasible: If there is none within `MOST_ROWS` rows and `LONGEST_SEARCH` seconds; the message says why.
    """
    step = _ClosedLoop(feedback, plant)
    return _rounded(step, invariant_rows(step.first_rows(), step.predecessor, len(plant.box_rows), progress))


def invariant_rows(
    rows: np.ndarray,
    predecessor: Callable[[np.ndarray], np.ndarray],
    kept: int,
    progress: Callable[[str], object] = lambda line: None,
) -> np.ndarray:
    """Returns the rows of the largest polytope in another one whose states stay in it, shape (r, n).

    Args:
        rows: Of the other one, |row z| <= 1, shape (k, n), in coordinates of similar size.
        predecessor: Of a row, shape (n,), what states fulfil exactly if the next ones fulfil the row for sure.
        kept: So many of the first rows stay even where others imply them; such rows are not followed then.
        progress: Called with a line of text now and then.

    Raises:
        Infeasible: If there are none within `MOST_ROWS` rows and `LONGEST_SEARCH` seconds, or `predecessor` raises it.
    """
    if kept > MOST_ROWS:
        raise _none(
            f"the safe box alone has {kept} rows, and it would need {MOST_ROWS} at most: leave out implied ones"
        )
    rows, _ = _without_implied(rows, kept)
    deadline, following = time.thread_time() + LONGEST_SEARCH, 0
    while following < len(rows):
        if following < kept and _largest(np.delete(rows, following, axis=0), rows[following])[0] <= 1.0 + _IMPLIED:
            following += 1
            continue
        if len(rows) > MOST_ROWS:  # what later ones imply leads nowhere else, either
            rows, following = _without_implied(rows, kept, following)
            if len(rows) > _LEAST_PRUNED * MOST_ROWS:
                raise _too_many()
        if time.thread_time() > deadline:
            raise _none(f"its search took longer than {LONGEST_SEARCH:g} s, less with fewer states or longer steps")
        if following % 50 == 0:
            progress(f"polytope: {len(rows)} rows")
        row = predecessor(rows[following])
        if _largest(rows, row)[0] > 1.0 + _IMPLIED:
            rows = np.concatenate([rows, row[None]])
        following += 1
    progress(f"polytope: which of {len(rows)} rows count")
    rows = _without_implied(rows, kept)[0]
    if len(rows) > MOST_ROWS:
        raise _too_many()
    return rows


def share_in_polytope(polytope: Polytope, plant: LinearPlant) -> float | None:
    """Returns the share of the safe box's volume that a polytope fills, to about three digits.

    None where states are inputs under way, or the box is no product of intervals.
    """
    points = points_of_box(plant, _POINTS_LOG2)
    return None if points is None else float((polytope.gauge(points) <= 1.0).mean())


def points_of_box(plant: LinearPlant, log2: int) -> np.ndarray | None:
    """Returns 2^log2 points that fill the safe box evenly, shape (2^log2, n); None as for `share_in_polytope`."""
    rows = plant.box_rows
    is_product = rows.shape == (plant.n, plant.n) and np.count_nonzero(rows) == plant.n
    if inputs_under_way(plant) or not is_product:
        return None
    points = 2.0 * qmc.Sobol(plant.n, scramble=False).random_base2(log2) - 1.0
    return points / np.abs(rows).sum(axis=0)


def share_of_points(feedback: Feedback, plant: LinearPlant, points: np.ndarray) -> float:
    """Returns what share of points of the safe box a fallback keeps in it for ever.

    They are those of the polytope of `invariant_polytope`, found without linear programs, and without the limit of
    rows. 0.0 where there is no such polytope, or `_MOST_STEPS` steps do not tell.

    Args:
        feedback: The fallback.
        plant: Its plant.
        points: Of the box, shape (count, n).
    """
    step, total = _ClosedLoop(feedback, plant), len(points)
    if np.abs(np.linalg.eigvals(step.next)).max() >= 1.0:
        return 0.0
    try:
        rows = step.first_rows()
        for _ in range(_MOST_STEPS):
            points = points[(np.abs(points @ (rows / step.widths).T) <= 1.0).all(axis=1)]
            rows = step.predecessor(rows)
            rows = rows[np.abs(rows).sum(axis=1) > 1.0]  # the others hold in all of the box
            if not (len(rows) and len(points)):
                return len(points) / total
    except Infeasible:
        pass
    return 0.0


class ClosedLoopGrid(NamedTuple):
    """What u = K x_hat makes of x at the times of a plant's grid; the g rows are ordered by time, then by box row.

    Attributes:
        images: c (A_tau + B_tau K), shape (g, n).
        left: What |image x| may be so that |c x| stays below 1 - eta for all errors and disturbances, shape (g,).
    """

    images: np.ndarray
    left: np.ndarray


def grid_in_closed_loop(feedback: Feedback, plant: LinearPlant) -> ClosedLoopGrid:
    """Returns the rows of docs/shield_proof.md, "Between the samples"; none for a plant without a grid."""
    if plant.grid_rows is None:
        return ClosedLoopGrid(np.empty((0, plant.n)), np.empty(0))
    (K, errors, D), (state, pushed, _) = feedback, plant.grid_rows
    answer, (left, disturbed) = pushed @ K, left_between_samples(plant, plant.grid_rows, D)
    reach = np.sqrt(np.einsum("...i,lij,...j->l...", answer, errors, answer).max(axis=0))
    return ClosedLoopGrid((state + answer).reshape(-1, plant.n), (left - disturbed - reach).ravel())


class _ClosedLoop:
    """What one step makes of rows, in units of the safe box."""

    def __init__(self, feedback: Feedback, plant: LinearPlant) -> None:
        self._plant, self._feedback = plant, feedback
        self._K, self._errors, self._D = feedback
        self.widths = plant.half_widths
        self.next = plant.A + plant.B @ self._K

    def first_rows(self) -> np.ndarray:
        """Returns the rows of the box and of the input limits, in units of the box.

        Raises:
            Infeasible: If errors of the estimate alone take an input beyond its limit.
        """
        allowed = self._plant.u_max * (1.0 - float(ACTION_ROUNDING) - _MARGIN) - self._reach(self._K)
        if (allowed <= 0.0).any():
            raise _none("the error of the estimate alone takes an input beyond its limit; better sensors leave room")
        rows, (images, left) = np.concatenate([self._plant.box_rows, self._K / allowed[:, None]]), self._on_grid()
        if (left <= 0.0).any():
            raise _none("errors and disturbances alone leave the box between two samples; smaller bounds leave room")
        return np.concatenate([rows, images / left[:, None]]) * self.widths

    def _on_grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns what u = K x_hat makes of x at the times of the grid, rows (g, n), and what |row x| may be, (g,)."""
        grid = grid_in_closed_loop(self._feedback, self._plant)
        return grid.images, grid.left - _MARGIN

    def predecessor(self, rows: np.ndarray) -> np.ndarray:
        """Returns what states have to fulfil so that the next ones fulfil a row, shape (n,), or rows, (k, n).

        All are in units of the box.

        Raises:
            Infeasible: If errors and disturbances alone leave a row.
        """
        physical = rows / self.widths
        pushed = physical @ self._plant.B
        left = 1.0 - _MARGIN - self._reach(pushed @ self._K) - np.sqrt(((physical @ self._D) * physical).sum(axis=-1))
        left = left - float(ACTION_ROUNDING) * (np.abs(pushed) @ self._plant.u_max)
        if (left <= 0.0).any():
            raise _none("errors and disturbances alone leave one of its faces; smaller bounds leave room")
        return (physical @ self.next) * self.widths / left[..., None]

    def _reach(self, rows: np.ndarray) -> np.ndarray:
        """Returns the largest support over the error sets of rows, shape (..., n) in physical units."""
        squares = np.einsum("...i,kij,...j->k...", rows, self._errors, rows)
        return np.sqrt(np.maximum(squares, 0.0)).max(axis=0)

    def in_physical_units(self, rows: np.ndarray) -> np.ndarray:
        """Returns rows in physical units, rounded; the rows of the box are those of the plant to the last bit."""
        rounded = exact.rounded(rows, _DIGITS, axis=1) / self.widths
        box = self._plant.box_rows
        return np.concatenate([box, rounded[len(box) :]])

    def multipliers(self, rows: np.ndarray) -> np.ndarray:
        """Returns what writes rows after one step, of the gain and on the grid as sums of rows, (r + m + g, r)."""
        scaled, limits, gains = rows * self.widths, self._plant.u_max, slice(len(rows), len(rows) + self._plant.m)
        images = np.concatenate([rows @ self.next, self._K / limits[:, None], self._on_grid()[0]]) * self.widths
        found = np.array([_largest(scaled, image)[1] for image in images])
        found[np.abs(found) < 1e-13] = 0.0
        found[gains] *= limits[:, None]
        return exact.rounded(found, _DIGITS + 2, axis=1)


def _none(reason: str) -> Infeasible:
    return Infeasible(reason, "P", 0.0)


def _too_many() -> Infeasible:
    return _none(f"it would need more than {MOST_ROWS} rows, fewer with longer steps or less disturbance")


def _largest(rows: np.ndarray, row: np.ndarray) -> tuple[float, np.ndarray]:
    """Returns max row z over |rows z| <= 1, and the multipliers, shape (r,), that prove it; infinite if unbounded."""
    found = linprog(
        -row,
        A_ub=np.concatenate([rows, -rows]),
        b_ub=np.ones(2 * len(rows)),
        bounds=(None, None),
        method="highs",
        options=_SOLVER,
    )
    if found.status != 0:
        return math.inf, np.zeros(len(rows))
    prices = -found.ineqlin.marginals
    return -found.fun, prices[: len(rows)] - prices[len(rows) :]


def _without_implied(rows: np.ndarray, kept: int, count: int = 0) -> tuple[np.ndarray, int]:
    """Returns rows without those that the others imply, and how many of the first `count` stay; the `kept` first do."""
    for i in range(len(rows) - 1, kept - 1, -1):
        others = np.delete(rows, i, axis=0)
        if _largest(others, rows[i])[0] <= 1.0 + _IMPLIED:
            rows, count = others, count - (i < count)
    return rows, count


def _rounded(step: _ClosedLoop, rows: np.ndarray) -> Polytope:
    physical = step.in_physical_units(rows)
    return Polytope(rows=physical, multipliers=step.multipliers(physical))
