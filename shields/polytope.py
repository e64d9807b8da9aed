"""A polytope of states that the fallback input keeps in the safe box, with the multipliers that prove it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ncs_gym import exact
from ncs_gym.limits import MOST_POINTS, sides
from ncs_gym.validation import (
    FILLED_IN_LATER,
    ReadOnlyArrays,
    as_matrix,
    as_vector,
    read_only,
    shown,
)
from shields.errors import CertificateError

# A polytope has at most so many rows, so that a decision and a verification stay fast; each stands for two faces.
MOST_ROWS = 400
# Multipliers belong to its rows, to as many inputs at most, and to the rows of a box at every time of a step.
MOST_MULTIPLIERS = (MOST_POINTS + 2) * MOST_ROWS


@dataclass(frozen=True, eq=False, kw_only=True)
class Polytope(ReadOnlyArrays):
    """The polytope P = {x : low <= G x <= high} around a point c (docs/shield_proof.md, "Polytopes").

    For every row g, and every row of the gain, multipliers lambda_i bound g (A+BK) x on P from above: g (A+BK) is
    sum_i lambda_i g_i but for rounding. Others bound it from below; where P is symmetric these are the same.

    Attributes:
        rows: G, shape (r, n) [1 per unit of the state]; the first are the rows of the safe box.
        low, high: Ends of the rows, shape (r,); -1 and 1 by default, infinite where there is none.
        center: c, shape (n,), strictly inside: the resting point of the fallback input; zero by default.
        multipliers: Lambda, shape (r + m, r): of the rows of P without unit, then of the gain's in the inputs' units.
        lower_multipliers: Those that bound from below, of the same shape; the same ones by default.
    """

    rows: np.ndarray
    multipliers: np.ndarray
    low: np.ndarray = FILLED_IN_LATER
    high: np.ndarray = FILLED_IN_LATER
    center: np.ndarray = FILLED_IN_LATER
    lower_multipliers: np.ndarray = FILLED_IN_LATER

    def __post_init__(self) -> None:
        try:
            rows = as_matrix(self.rows, (None, None), "the rows of the polytope")
            multipliers = as_matrix(self.multipliers, (None, len(rows)), "the multipliers of the polytope")
            _require_size(len(rows), len(multipliers))
            low, high = _ends_of(self.low, self.high, len(rows))
            n = rows.shape[1]
            center = np.zeros(n) if self.center is None else as_vector(self.center, n, "the center of the polytope")
            lower = multipliers
            if self.lower_multipliers is not None:
                lower = as_matrix(self.lower_multipliers, multipliers.shape, "the lower multipliers of the polytope")
            reached = rows @ center
            if not ((low < reached) & (reached < high)).all():
                raise ValueError("the center of the polytope is not inside")
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: {error}") from error
        self._set(rows=rows, multipliers=multipliers, low=low, high=high, center=center, lower_multipliers=lower)

    @cached_property
    def is_symmetric(self) -> bool:
        """Whether it says |g x| <= 1 for all rows, with the same multipliers from above and below."""
        same = np.array_equal(self.multipliers, self.lower_multipliers)
        return bool((self.low == -1.0).all() and (self.high == 1.0).all() and not self.center.any() and same)

    @cached_property
    def F(self) -> np.ndarray:
        """All faces: P = {x : F (x - c) <= 1}, shape (q, n); those of high ends, and then those of low ones."""
        reached = self.rows @ self.center
        above, below = np.isfinite(self.high), np.isfinite(self.low)
        ends = np.concatenate([(self.high - reached)[above], (self.low - reached)[below]])
        return read_only(np.concatenate([self.rows[above], self.rows[below]]) / ends[:, None])

    @cached_property
    def widths(self) -> np.ndarray:
        """Bounds of |x_i - c_i| in P as floats tell, shape (n,); infinite where rows with two ends give none."""
        bounded = np.isfinite(self.low) & np.isfinite(self.high)
        rows, reached = self.rows[bounded], self.rows[bounded] @ self.center
        sizes = np.maximum(self.high[bounded] - reached, reached - self.low[bounded])
        if not len(rows) or exact.rank(rows) < self.dim:
            return np.full(self.dim, np.inf)
        units = 1.0 / np.abs(rows / sizes[:, None]).max(axis=0)
        return units * np.abs(np.linalg.pinv(rows * units / sizes[:, None])).sum(axis=1)

    @property
    def dim(self) -> int:
        """The dimension n."""
        return self.rows.shape[1]

    def gauge(self, points: Any) -> Any:
        """Returns max f (x - c) over the faces f: 0 at the center, 1 on the boundary.

        Args:
            points: x, shape (n,), which gives a float, or (count, n), which gives shape (count,).
        """
        gauges = ((np.asarray(points, dtype=np.float64) - self.center) @ self.F.T).max(axis=-1)
        return float(gauges) if gauges.ndim == 0 else gauges

    def support(self, directions: Any) -> Any:
        """Returns max a'x for a direction a, (n,), or each of (count, n), by a solver: no proof takes it.

        Raises:
            ValueError: If the polytope is unbounded in a direction.
        """
        from scipy.optimize import linprog  # takes long to import

        units = 1.0 / np.abs(self.rows).max(axis=0)  # the solver drops small coefficients
        rows, ones, found = self.F * units, np.ones(len(self.F)), []
        given = np.atleast_2d(np.asarray(directions, dtype=np.float64))
        for direction in given * units:
            size = float(np.abs(direction).max()) or 1.0
            solution = linprog(-direction / size, A_ub=rows, b_ub=ones, bounds=(None, None))
            if solution.status != 0:
                raise ValueError(f"the polytope has no support in a direction: {solution.message}")
            found.append(-solution.fun * size)
        reached = np.array(found) + given @ self.center
        return float(reached[0]) if np.ndim(directions) == 1 else reached

    def contains(self, point: np.ndarray) -> bool:
        """Returns whether a point, shape (n,), lies inside or on the boundary (in float64, no tolerance)."""
        return self.gauge(point) <= 1.0

    def sample_boundary(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Returns points of the boundary in random directions, shape (count, n)."""
        scale = 1.0 / np.maximum(np.abs(self.rows).max(axis=0), np.finfo(float).tiny)
        directions = rng.standard_normal((count, self.dim)) * scale
        return self.center + directions / self.gauge(self.center + directions)[:, None]


def _require_size(rows: int, multipliers: int) -> None:
    if rows > MOST_ROWS or multipliers > MOST_MULTIPLIERS:
        raise ValueError(
            f"a polytope has at most {MOST_ROWS} rows and {MOST_MULTIPLIERS} rows of multipliers, got {rows} and "
            f"{multipliers}"
        )


def _ends_of(low: Any, high: Any, rows: int) -> np.ndarray:
    """Returns the ends of rows, shape (2, rows): -1 and 1 for None; None in a list stands for an infinite one."""
    if low is None and high is None:
        return np.array([[-1.0], [1.0]]) * np.ones(rows)
    given = tuple(
        [infinity if each is None else each for each in side] if isinstance(side, list) else side
        for side, infinity in ((low, -np.inf), (high, np.inf))
    )
    ends = sides(given, rows, "the ends of the polytope")
    if not np.isfinite(ends).any(axis=0).all():
        raise ValueError(f"one of the ends of the polytope must be finite for each row, got {shown(given)}")
    return ends


def _listed(ends: np.ndarray) -> list[float | None]:
    return [each if np.isfinite(each) else None for each in ends.tolist()]


def polytope_content(polytope: Polytope) -> dict[str, Any]:
    """Returns JSON values without defaults and the center; multipliers are pairs [number of the row, value]."""
    content = {"rows": polytope.rows.tolist(), "multipliers": _pairs_of(polytope.multipliers)}
    if polytope.is_symmetric:
        return content
    ends = {"low": _listed(polytope.low), "high": _listed(polytope.high)}
    return content | ends | {"lower_multipliers": _pairs_of(polytope.lower_multipliers)}


def _pairs_of(multipliers: np.ndarray) -> list[list[list[Any]]]:
    return [[[int(i), float(row[i])] for i in np.flatnonzero(row)] for row in multipliers]


def polytope_of(content: Any, center: Any) -> Polytope:
    """Returns the polytope that JSON values hold, around a point, shape (n,).

    Raises:
        KeyError, TypeError, ValueError: If an entry is missing or of a wrong kind.
    """
    rows = as_matrix(content["rows"], (None, None), "the rows of the polytope")
    fields = {"multipliers": _multipliers_of(content["multipliers"], len(rows))}
    if "low" in content:
        fields |= {"low": content["low"], "high": content["high"]}
        fields["lower_multipliers"] = _multipliers_of(content["lower_multipliers"], len(rows))
    return Polytope(rows=rows, center=center, **fields)


def _multipliers_of(pairs: Any, rows: int) -> np.ndarray:
    _require_size(rows, len(pairs))
    multipliers = np.zeros((len(pairs), rows))
    for row, entries in zip(multipliers, pairs, strict=True):
        if len({index for index, _ in entries}) < len(entries):
            raise ValueError("a multiplier of the polytope is given twice")
        for index, value in entries:
            if type(index) is not int or not 0 <= index < len(row) or type(value) is not float or value == 0.0:
                raise ValueError(f"a multiplier of the polytope must be [number of a row, value], got {shown(entries)}")
            row[index] = value
    return multipliers
