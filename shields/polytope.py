"""A polytope of states that the fallback input keeps in the safe box, with the multipliers that prove it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import linprog

from ncs_gym.plants.between_samples import MOST_POINTS
from ncs_gym.validation import ReadOnlyArrays, as_matrix, own_error_state, read_only, shown
from shields.errors import CertificateError

# A polytope has at most so many rows, so that a decision and a verification stay fast; each stands for two faces.
MOST_ROWS = 400
# Multipliers belong to its rows, to as many inputs at most, and to the rows of a box at every time of a step.
MOST_MULTIPLIERS = (MOST_POINTS + 2) * MOST_ROWS


@dataclass(frozen=True, eq=False, kw_only=True)
class Polytope(ReadOnlyArrays):
    """The polytope P = {x : |g x| <= 1 for every row g} (docs/shield_proof.md, "Polytopes").

    For every row g, and for every row of the gain K, there are numbers lambda_i that write what the closed loop makes
    of it as a sum of rows, g (A+BK) = sum_i lambda_i g_i + r; what is left, r, is mere rounding. P is symmetric, so
    that one row stands for two faces and a lambda_i may have either sign.

    Attributes:
        rows: G, shape (r, n) [1 per unit of the state]; the first are the rows of the safe box.
        multipliers: Lambda, shape (r + m, r): of the rows of P without unit, then of the gain's in the inputs' units.
    """

    rows: np.ndarray
    multipliers: np.ndarray

    def __post_init__(self) -> None:
        """Raises CertificateError if the shapes do not fit, a number is not finite, or there are too many rows."""
        try:
            rows = as_matrix(self.rows, (None, None), "the rows of the polytope")
            multipliers = as_matrix(self.multipliers, (None, len(rows)), "the multipliers of the polytope")
            require_size(len(rows), len(multipliers))
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: {error}") from error
        object.__setattr__(self, "rows", rows)
        object.__setattr__(self, "multipliers", multipliers)
        self._make_arrays_read_only()

    @cached_property
    def low(self) -> np.ndarray:
        """The lower ends of the rows, shape (r,): -1, since P is symmetric."""
        return read_only(np.full(len(self.rows), -1.0))

    @cached_property
    def high(self) -> np.ndarray:
        """The upper ends of the rows, shape (r,): 1."""
        return read_only(np.ones(len(self.rows)))

    @cached_property
    def F(self) -> np.ndarray:
        """All faces: P = {x : F x <= 1}, shape (2 r, n); the rows, and then the negative ones."""
        return read_only(np.concatenate([self.rows, -self.rows]))

    @property
    def dim(self) -> int:
        """The dimension n."""
        return self.rows.shape[1]

    @own_error_state
    def gauge(self, points: Any) -> Any:
        """Returns max |g x| over the rows: 0 at the center, 1 on the boundary.

        Args:
            points: x, shape (n,), which gives a float, or (count, n), which gives shape (count,).
        """
        gauges = np.abs(np.asarray(points, dtype=np.float64) @ self.rows.T).max(axis=-1)
        return float(gauges) if gauges.ndim == 0 else gauges

    @own_error_state
    def support(self, directions: Any) -> Any:
        """Returns max of a'x over the polytope for a direction a (n,), or for each of shape (count, n), by a solver.

        For pictures and tests: no proof takes it.

        Raises:
            ValueError: If the polytope is unbounded in a direction.
        """
        units = 1.0 / np.abs(self.rows).max(axis=0)  # the solver drops small coefficients
        rows, ones = self.F * units, np.ones(2 * len(self.rows))
        found = []
        for direction in np.atleast_2d(np.asarray(directions, dtype=np.float64)) * units:
            size = float(np.abs(direction).max()) or 1.0
            solution = linprog(-direction / size, A_ub=rows, b_ub=ones, bounds=(None, None))
            if solution.status != 0:
                raise ValueError(f"the polytope has no support in a direction: {solution.message}")
            found.append(-solution.fun * size)
        return float(found[0]) if np.ndim(directions) == 1 else np.array(found)

    @own_error_state
    def outline(self, pair: tuple[int, int]) -> np.ndarray:
        """Returns corners of a polygon around the projection onto two coordinates, shape (k, 2); for pictures.

        It is bounded by tangents every 3 degrees, the axes among them.
        """
        angles = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
        normals = np.column_stack([np.cos(angles), np.sin(angles)]) * np.abs(self.rows[:, pair]).max(axis=0)
        directions = np.zeros((len(angles), self.dim))
        directions[:, pair] = normals
        heights = self.support(directions)
        # Where every tangent meets the next one.
        normals = np.stack([normals, np.roll(normals, -1, axis=0)], axis=1)
        heights = np.stack([heights, np.roll(heights, -1)], axis=1)
        return np.linalg.solve(normals, heights[..., None])[..., 0]

    @own_error_state
    def contains(self, point: np.ndarray) -> bool:
        """Returns whether a point, shape (n,), lies inside or on the boundary (in float64, no tolerance)."""
        return self.gauge(point) <= 1.0

    @own_error_state
    def sample_boundary(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Returns points of the boundary in random directions, shape (count, n)."""
        scale = 1.0 / np.maximum(np.abs(self.rows).max(axis=0), np.finfo(float).tiny)
        directions = rng.standard_normal((count, self.dim)) * scale
        return directions / self.gauge(directions)[:, None]


def require_size(rows: int, multipliers: int) -> None:
    """Raises ValueError if a polytope would have more rows, or rows of multipliers, than any may have."""
    if rows > MOST_ROWS or multipliers > MOST_MULTIPLIERS:
        raise ValueError(
            f"a polytope has at most {MOST_ROWS} rows and {MOST_MULTIPLIERS} rows of multipliers, got {rows} and "
            f"{multipliers}"
        )


def polytope_content(polytope: Polytope) -> dict[str, Any]:
    """Returns the JSON values of a polytope; of the multipliers the pairs [number of the row, value] that count."""
    multipliers = [[[int(i), float(row[i])] for i in np.flatnonzero(row)] for row in polytope.multipliers]
    return {"rows": polytope.rows.tolist(), "multipliers": multipliers}


def polytope_of(content: Any) -> Polytope:
    """Returns the polytope that JSON values hold.

    Raises:
        KeyError, TypeError, ValueError: If an entry is missing or of a wrong kind.
    """
    rows, pairs = as_matrix(content["rows"], (None, None), "the rows of the polytope"), content["multipliers"]
    require_size(len(rows), len(pairs))
    multipliers = np.zeros((len(pairs), len(rows)))
    for row, entries in zip(multipliers, pairs, strict=True):
        if len({index for index, _ in entries}) < len(entries):
            raise ValueError("a multiplier of the polytope is given twice")
        for index, value in entries:
            if type(index) is not int or not 0 <= index < len(row) or type(value) is not float or value == 0.0:
                raise ValueError(f"a multiplier of the polytope must be [number of a row, value], got {shown(entries)}")
            row[index] = value
    return Polytope(rows=rows, multipliers=multipliers)
