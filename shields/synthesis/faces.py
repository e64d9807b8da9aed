"""Rows with two ends, and what a polytope of them implies of other rows."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import highspy
import numpy as np
from scipy.optimize import linprog

# The ends of one row that are open.
OPEN = np.array([-math.inf]), np.array([math.inf])
# The solver's own tolerances, next to units of 1.
_TOLERANCES = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
# Programs are small: what a presolve does takes longer than it saves.
_SOLVER = {"output_flag": False, "small_matrix_value": 1e-12, "presolve": "off", "solver": "simplex"} | _TOLERANCES
# The solver refuses larger numbers.
_LARGEST = 1e15
# What the solver says of a linear program without an end.
_NO_END = (highspy.HighsModelStatus.kUnbounded, highspy.HighsModelStatus.kUnboundedOrInfeasible)


class Faces(NamedTuple):
    """Rows with two ends, low <= g z <= high, shape (r, n), around z = 0; an end that is open is infinite."""

    rows: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def some(self, chosen: Any) -> Faces:
        """Returns some of them, given by their numbers or a mask."""
        return Faces(*(part[chosen] for part in self))

    def followed_by(self, others: Faces) -> Faces:
        """Returns these and then others."""
        return Faces(*(np.concatenate(pair) for pair in zip(self, others, strict=True)))

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Returns whether points, shape (count, n), lie between the ends of all rows, shape (count,)."""
        values = points @ self.rows.T
        return np.all((self.low <= values) & (values <= self.high), axis=1)

    @property
    def are_symmetric(self) -> bool:
        """Whether the ends of every row are equally far away."""
        return np.array_equal(-self.low, self.high)


class _SilentHighs(highspy.Highs):
    """A solver that prints nothing, not even its banner when it is made."""

    def enableCallbacks(self) -> None:
        self.silent()
        super().enableCallbacks()


class Extremes:
    """The least and the largest values that rows take in a polytope.

    Each is a linear program, in which HiGHS (Huangfu and Hall 2018, docs/bibliography.md) goes on from the solution of
    the one before. Numbers out of its reach raise ArithmeticError.
    """

    def __init__(self, faces: Faces) -> None:
        self._faces, self._n = Faces(*(part.copy() for part in faces)), faces.rows.shape[1]
        self._columns = np.arange(self._n, dtype=np.int32)
        self._solver = _SilentHighs()
        for name, value in _SOLVER.items():
            self._solver.setOptionValue(name, value)
        self._solver.addVars(self._n, np.full(self._n, -math.inf), np.full(self._n, math.inf))
        self._solver.changeObjectiveSense(highspy.ObjSense.kMaximize)
        self._add(faces)

    @property
    def faces(self) -> Faces:
        """The faces of the polytope."""
        return self._faces

    def add(self, faces: Faces) -> None:
        """Adds faces."""
        self._faces = self._faces.followed_by(faces)
        self._add(faces)

    def set_ends(self, number: int, low: float, high: float) -> None:
        """Gives a face other ends."""
        self._faces.low[number], self._faces.high[number] = low, high
        self._solver.changeRowBounds(number, low, high)

    def _add(self, faces: Faces) -> None:
        rows = np.ascontiguousarray(faces.rows)
        starts, columns = np.arange(0, rows.size, self._n, dtype=np.int32), np.tile(self._columns, len(rows))
        _check(rows)
        self._solver.addRows(len(rows), faces.low, faces.high, rows.size, starts, columns, rows.ravel())

    def of(self, row: np.ndarray) -> tuple[float, float]:
        """Returns the least and the largest row z, shape (n,), infinite where there is none."""
        return self.least(row), self.largest(row)

    def least(self, row: np.ndarray) -> float:
        """Returns the least row z, shape (n,); minus infinity where there is none."""
        return -self.largest(row if self._faces.are_symmetric else -row)

    def bounds(self, row: np.ndarray, reach: np.ndarray) -> tuple[float, float]:
        """Returns bounds of row z, shape (n,), that hold whatever the solver says, up to rounding.

        For any multipliers l, row z = l G z + (row - l G) z.

        Args:
            row: Of numbers about 1, since the solver's tolerances are absolute.
            reach: Bounds of |z|, shape (n,).
        """
        above = self._bound(row, reach)
        return -above if self._faces.are_symmetric else -self._bound(-row, reach), above

    def _bound(self, row: np.ndarray, reach: np.ndarray) -> float:
        self.largest(row)
        found = np.array(self._solver.getSolution().row_dual)
        some = found if found.shape == self._faces.low.shape and np.isfinite(found).all() else 0.0 * self._faces.low
        return min(self._bound_by(row, reach, each) for each in (some, -some, np.zeros(len(self._faces.rows))))

    def _bound_by(self, row: np.ndarray, reach: np.ndarray, multipliers: np.ndarray) -> float:
        ends = np.where(multipliers > 0.0, self._faces.high, self._faces.low)
        multipliers = np.where(np.isfinite(ends), multipliers, 0.0)  # an open end proves nothing
        used = multipliers != 0.0
        return float(multipliers[used] @ ends[used] + np.abs(row - multipliers @ self._faces.rows) @ reach)

    def largest(self, row: np.ndarray) -> float:
        """Returns the largest row z, shape (n,); infinity where there is none."""
        _check(row)
        solver = self._solver
        solver.changeColsCost(self._n, self._columns, row)
        solver.run()
        if solver.getModelStatus() not in (highspy.HighsModelStatus.kOptimal, *_NO_END):
            solver.clearSolver()  # from the beginning
            solver.run()
        return solver.getObjectiveValue() if solver.getModelStatus() == highspy.HighsModelStatus.kOptimal else math.inf


def multipliers_of(faces: Faces, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns what proves the least and the largest row z, shape (n,): row as sums of the rows of faces, (r,) each.

    Zeros where there is no such value. Nothing is left here of programs that were solved before.
    """
    largest = _multipliers(faces, row)
    return (largest if faces.are_symmetric else -_multipliers(faces, -row)), largest


def _multipliers(faces: Faces, row: np.ndarray) -> np.ndarray:
    above, below = np.isfinite(faces.high), np.isfinite(faces.low)
    rows = np.concatenate([faces.rows[above], -faces.rows[below]])
    ends = np.concatenate([faces.high[above], -faces.low[below]])
    multipliers = np.zeros(len(faces.rows))
    for presolve in (True, False):  # now and then a presolve fails
        options = _TOLERANCES | {"presolve": presolve}
        found = linprog(-row, A_ub=rows, b_ub=ends, bounds=(None, None), method="highs", options=options)
        if found.status == 0:
            prices = -found.ineqlin.marginals
            multipliers[above] += prices[: np.count_nonzero(above)]
            multipliers[below] -= prices[np.count_nonzero(above) :]
            break
    return multipliers


def _check(rows: np.ndarray) -> None:
    if not (np.abs(rows) < _LARGEST).all():
        raise ArithmeticError(f"a row of a linear program has numbers from {_LARGEST:g} on")
