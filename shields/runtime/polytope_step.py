"""The one-step test row by row: which inputs keep every possible next state in a polytope, or between two samples.

The supports of errors and disturbances add up, so the test is exact for what is known. Between samples the rows are
those of the box at the times of a grid (docs/shield_proof.md).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.validation import own_error_state, read_only
from shields.polytope import Polytope
from shields.runtime.one_step import (
    FARTHEST,
    SMALLEST_RADIUS,
    OneStepTest,
    PredictedErrors,
    ReachableSet,
    ReachableSets,
    judged_shapes,
)
from shields.runtime.projection import closest_between

# Projections onto either of two sets of inputs, in turn.
ALTERNATIONS = 8
# Entries of an array that are worked on together: as many as a processor keeps near.
BLOCK = 131_072
# Outward rounding of rows that are divided by what is left of the box.
_OUTWARD = 1.0 + 1e-12


class PolytopeTest:
    """Whether everything one step can reach lies in P = {x : |G x| <= 1} (docs/shield_proof.md, "Polytopes").

    x+ = A x_hat + B u - A e + d with e in E(Sigma_k) and d in E(D), so the test is, for all rows g,

        |g (A x_hat + B u)| + sqrt(g A Sigma_k A' g') + sqrt(g D g') + rounding <= 1.

    Where the box counts between samples, too, the rows of the grid (`GridTest`) stand below those of P.

    It has what `OneStepTest` has, for P in place of S: the filter calls either, and hands on what they return.

    Args:
        polytope: P; None for the rows of the grid alone.
        plant: Gives A, B, D and the limits.

    Attributes:
        root: G, shape (r, n).
        moved, effect: G A and G B, shapes (r, n) and (r, m), and then the rows of the grid; joint: both beside each
            other.
        disturbed: sqrt(g D g') with the rounding of computing it, and what stands for it on the grid, shape (r,).
        rounding: Bound on the rounding of a product with G, relative to the product of absolute values.
        columns, own_columns: Largest entries of the columns of |G| |A| and of |G|, shape (n,).
        pushed: Largest |G| |B| |u| within the limits.
        shift: Largest |G B u| within the limits, to which the rounding of an action is relative.
        limits: Entries of u_max.
    """

    @own_error_state  # what is not finite passes no test
    def __init__(self, polytope: Polytope | None, plant: LinearPlant) -> None:
        self.plant = plant
        self.limits = plant.u_max.tolist()
        grid = grid_test(plant)
        self.root = np.empty((0, plant.n)) if polytope is None else polytope.rows
        self.moved = read_only(np.concatenate([self.root @ plant.A, grid.moved]))
        self.effect = read_only(np.concatenate([self.root @ plant.B, grid.effect]))
        self.joint = read_only(np.hstack([self.moved, self.effect]))
        self.rounding = 8.0 * (plant.n + plant.m) * float(np.finfo(float).eps)
        size = np.abs(self.root)
        pushes = np.concatenate([size @ np.abs(plant.B), np.abs(grid.effect)]) @ plant.u_max
        self.columns = read_only(np.concatenate([size @ np.abs(plant.A), np.abs(grid.moved)]).max(axis=0))
        self.own_columns = read_only(size.max(axis=0, initial=0.0))
        self.pushed = float(pushes.max())
        self.shift = float((np.abs(self.effect) @ plant.u_max).max())
        D = plant.disturbance.shape_matrix
        extent = float(self.own_columns @ np.sqrt(np.diag(D)))
        disturbed = supports(self.root, D, self.rounding * extent**2)
        self.disturbed = read_only(np.concatenate([disturbed, grid.disturbed]))

    @own_error_state  # what overflows passes no test, what underflows does not count
    def predicted(self, shapes: np.ndarray, certified_shapes: np.ndarray) -> PredictedErrors:
        """Returns what the test and the guarantee need of error shapes; see `OneStepTest.predicted`."""
        symmetric, usable, inside = judged_shapes(shapes, certified_shapes)
        half_widths = np.sqrt(np.diagonal(symmetric, axis1=1, axis2=2))
        spread, own_spread = half_widths @ self.columns, half_widths @ self.own_columns
        reach = supports(self.moved, symmetric, self.rounding * spread[:, None] ** 2).T + self.disturbed[:, None]
        row_limits = 1.0 - reach * (1.0 + self.rounding) - self.rounding * (spread + self.pushed)
        own = supports(self.root, symmetric, self.rounding * own_spread[:, None] ** 2).T
        usable &= np.isfinite(row_limits).all(axis=0) & np.isfinite(own).all(axis=0)
        unusable = np.where(usable, 0.0, np.nan)
        return PredictedErrors(
            weighting=np.empty((0, 0, len(shapes))),
            row_limits=np.ascontiguousarray(row_limits + unusable),
            radius=row_limits.min(axis=0) + unusable,
            half_widths=np.ascontiguousarray((half_widths + unusable[:, None]).T),
            own=np.ascontiguousarray(own + unusable),
            certified=inside & usable,
            shape=np.ascontiguousarray(shapes.transpose(1, 2, 0)),
        )

    def reachable(self, estimates: np.ndarray, errors: PredictedErrors) -> Any:
        """Returns the `PolytopeSets` of next states that N estimates allow, shape (n, N)."""
        reach = self.columns @ np.abs(estimates)
        rounding = np.where(reach < FARTHEST, self.rounding * reach, np.nan)  # what is too far out is unknown
        return PolytopeSets(self, estimates, errors.row_limits, rounding, errors.radius - rounding)

    def reachable_alone(self, estimate: np.ndarray, errors: PredictedErrors) -> Any:
        """Returns the `PolytopeSet` of one estimate, shape (n,), and one error shape; None if nothing passes."""
        rounding = self.rounding * float(self.columns.dot(np.abs(estimate)))
        if not errors.radius - rounding >= SMALLEST_RADIUS:  # neither NaN
            return None
        return PolytopeSet(self, estimate, self.moved.dot(estimate), errors.row_limits - rounding)

    @own_error_state
    def knows_inside(self, estimates: np.ndarray, errors: PredictedErrors, margin: float) -> np.ndarray:
        """Returns whether |g x_hat| + sqrt(g Sigma_k g') <= 1 - margin for all rows, which proves that x is in P."""
        level = (np.abs(self.root.dot(estimates)) + errors.own).max(axis=0)
        return level <= 1.0 - margin - self.rounding * self.own_columns.dot(np.abs(estimates))

    @own_error_state
    def keeps_between(
        self, estimate: np.ndarray, errors: PredictedErrors, margin: float, u: np.ndarray | None = None
    ) -> bool:
        """Returns whether the box is kept between this sample and the next, if that counts, with input u or none."""
        first = len(self.root)
        rounding = self.rounding * float(self.columns.dot(np.abs(estimate)))
        values = self.moved[first:].dot(estimate)
        values = values if u is None else values + self.effect[first:].dot(u)
        return bool((np.abs(values) <= errors.row_limits[first:] - rounding - margin).all())


class PolytopeSets(NamedTuple):
    """Where next states lie, row by row, for each of N environments.

    Attributes:
        test: What holds for all of them.
        estimates: x_hat, shape (n, N).
        row_limits: Largest |g (A x_hat + B u)| that passes, shape (r, N), before
        rounding: what they lose by rounding, shape (N,); NaN if nothing is known.
        radius: The least row limit left, shape (N,).
    """

    test: PolytopeTest
    estimates: np.ndarray
    row_limits: np.ndarray
    rounding: np.ndarray
    radius: np.ndarray

    def some(self, chosen: np.ndarray) -> PolytopeSets:
        """Returns those of some environments, given by their indices."""
        return PolytopeSets(self.test, *(array.take(chosen, axis=-1) for array in self[1:]))

    def margins(self, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns what `ReachableSets.margins` does."""
        joint, least = np.concatenate([self.estimates, inputs]), np.empty(inputs.shape[1])
        block = max(1, BLOCK // len(self.test.moved))
        for start in range(0, len(least), block):
            part = slice(start, start + block)
            center = self.test.joint @ joint[:, part]
            np.abs(center, out=center)
            np.subtract(self.row_limits[:, part], center, out=center)
            least[part] = center.min(axis=0)
        least -= self.rounding
        return least, least.copy()

    def smallest_test_margin(self) -> np.ndarray:
        """Returns that of the worst input within the limits, shape (N,)."""
        worst = np.abs(self.test.effect) @ self.test.plant.u_max
        center = np.abs(self.test.moved @ self.estimates)
        return (self.row_limits - center - worst[:, None]).min(axis=0) - self.rounding

    def closest(self, inputs: np.ndarray, margin: float) -> np.ndarray:
        """Returns what `ReachableSets.closest` does."""
        limits, count = self.test.plant.u_max, inputs.shape[1]
        block = max(1, BLOCK // (len(self.test.moved) * len(limits)))
        if len(limits) > 1 and count > block:
            parts = [np.arange(start, min(start + block, count)) for start in range(0, count, block)]
            return np.hstack([self.some(part).closest(inputs[:, part], margin) for part in parts])
        rows = np.concatenate([self.test.effect, np.eye(len(limits))])
        offset = np.concatenate([self.test.moved @ self.estimates, np.zeros(inputs.shape)])
        bounds = np.concatenate([self.row_limits - self.rounding - margin, np.repeat(limits[:, None], count, axis=1)])
        return closest_between(inputs, offset, rows[..., None], bounds)


class EllipsoidOnGrid(OneStepTest):
    """`OneStepTest` for a plant whose box counts between samples, too: its rows of the grid have to hold as well.

    Args:
        L: Shape of S.
        plant: With a grid.

    Attributes:
        grid: The test of these rows.
    """

    def __init__(self, L: np.ndarray, plant: LinearPlant) -> None:
        super().__init__(L, plant)
        self.grid = PolytopeTest(None, plant)
        self.shift = max(self.shift, self.grid.shift)

    def predicted(self, shapes: np.ndarray, certified_shapes: np.ndarray) -> PredictedErrors:
        """Returns what `OneStepTest.predicted` does, and the row limits of the grid."""
        row_limits = self.grid.predicted(shapes, certified_shapes[:0]).row_limits
        return super().predicted(shapes, certified_shapes)._replace(row_limits=row_limits)

    def reachable(self, estimates: np.ndarray, errors: PredictedErrors) -> Any:
        """Returns the `SetsOnGrid` of next states and of states until then."""
        return SetsOnGrid(super().reachable(estimates, errors), self.grid.reachable(estimates, errors))

    def reachable_alone(self, estimate: np.ndarray, errors: PredictedErrors) -> Any:
        """Returns what `reachable` does for one estimate, shape (n,); None if nothing passes."""
        first, grid = super().reachable_alone(estimate, errors), self.grid.reachable_alone(estimate, errors)
        return None if first is None or grid is None else SetOnGrid(first, grid)

    def keeps_between(
        self, estimate: np.ndarray, errors: PredictedErrors, margin: float, u: np.ndarray | None = None
    ) -> bool:
        """Returns what `PolytopeTest.keeps_between` does."""
        return self.grid.keeps_between(estimate, errors, margin, u)


class SetsOnGrid(NamedTuple):
    """Where next states lie, and where states are between now and then, for each of N environments.

    Attributes:
        first: The sets of next states.
        grid: What the rows of the grid allow.
    """

    first: ReachableSets
    grid: PolytopeSets

    @property
    def radius(self) -> np.ndarray:
        """That of the first, shape (N,)."""
        return self.first.radius

    def some(self, chosen: np.ndarray) -> SetsOnGrid:
        """Returns those of some environments, given by their indices."""
        return SetsOnGrid(self.first.some(chosen), self.grid.some(chosen))

    def margins(self, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the smaller test and reported margins of inputs u, shape (m, N); each has shape (N,)."""
        return tuple(map(np.minimum, self.first.margins(inputs), self.grid.margins(inputs)))  # pyright: ignore

    def smallest_test_margin(self) -> np.ndarray:
        """Returns that of the worst input within the limits, shape (N,)."""
        return np.minimum(self.first.smallest_test_margin(), self.grid.smallest_test_margin())

    def closest(self, inputs: np.ndarray, margin: float) -> np.ndarray:
        """Returns inputs within the limits, shape (m, N), near given ones with this test margin.

        A single input is in two intervals, and the closest point of one to the closest of the other is that of both.
        Of several inputs projections alternate: the result need not be the closest, nor pass, and the caller tests it.
        """
        for _ in range(1 if len(inputs) == 1 else ALTERNATIONS):
            inputs = self.grid.closest(self.first.closest(inputs, margin), margin)
        return inputs


class SetOnGrid(NamedTuple):
    """`SetsOnGrid` of a single environment."""

    first: ReachableSet
    grid: PolytopeSet

    def margins(self, u: np.ndarray) -> tuple[float, float]:
        """Returns the smaller test and reported margin of an input u, shape (m,)."""
        return tuple(map(min, self.first.margins(u), self.grid.margins(u)))  # pyright: ignore

    def closest(self, u: float, margin: float) -> float:
        """Returns what `SetsOnGrid.closest` does for plants with a single input."""
        return self.grid.closest(self.first.closest(u, margin), margin)


class PolytopeSet(NamedTuple):
    """`PolytopeSets` of a single environment: the same formulas without its axis.

    Attributes:
        test: What holds for all environments.
        estimate: x_hat, shape (n,).
        offset: G A x_hat, shape (r,).
        row_limits: Largest |g (A x_hat + B u)| that passes, shape (r,).
    """

    test: PolytopeTest
    estimate: np.ndarray
    offset: np.ndarray
    row_limits: np.ndarray

    def margins(self, u: np.ndarray) -> tuple[float, float]:
        """Returns test and reported margin of an input u, shape (m,)."""
        margin = float((self.row_limits - np.abs(self.offset + self.test.effect.dot(u))).min())
        return margin, margin

    def closest(self, u: float, margin: float) -> float:
        """Returns what `PolytopeSets.closest` does for plants with a single input."""
        limits = self.row_limits[:, None]
        sets = PolytopeSets(self.test, self.estimate[:, None], limits, np.zeros(1), limits[0])
        return float(sets.closest(np.array([[u]]), margin)[0, 0])


class GridTest(NamedTuple):
    """|row (A_tau x_hat + B_tau u)| + support of A_tau e + disturbed <= 1 at the times tau_i, i = 1..N-1.

    Rows are those of the box, divided by what eta leaves of it; no rows for a plant that counts at samples alone.

    Attributes:
        moved: Rows on x_hat, shape (g, n).
        effect: Rows on u, shape (g, m).
        disturbed: Support of the disturbances, shape (g,).
        at_samples: Rows on the state at a sampling instant, shape (k, n), from which the box is kept until the first of
            these times: those of the box divided by what eta and the disturbances leave, or the box's own.
    """

    moved: np.ndarray
    effect: np.ndarray
    disturbed: np.ndarray
    at_samples: np.ndarray

    def values(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Returns the rows at states x_hat, shape (N, n), and inputs, (N, m): shape (N, g), without any disturbance."""
        return states @ self.moved.T + inputs @ self.effect.T


@own_error_state  # what is not finite passes no test
def grid_test(plant: LinearPlant) -> GridTest:
    """Returns the test of a plant's grid."""
    rows, grid = plant.box_rows, plant.grid_rows
    if grid is None:
        return GridTest(np.empty((0, plant.n)), np.empty((0, plant.m)), np.empty(0), rows)
    D, rounding = plant.disturbance.shape_matrix, 8.0 * plant.n * float(np.finfo(float).eps)
    left = (1.0 - grid.remainder) / _OUTWARD
    rho = supports(rows, D, rounding * (np.abs(rows) @ np.sqrt(np.diag(D))) ** 2)
    at_samples = np.where(left > rho, left - rho, 0.0) / _OUTWARD
    count = len(grid.state) - 1
    return GridTest(
        moved=read_only((grid.state[1:] / left[:, None]).reshape(-1, plant.n)),
        effect=read_only((grid.input[1:] / left[:, None]).reshape(-1, plant.m)),
        disturbed=read_only(np.tile(np.where(left > 0.0, rho / left, np.inf), count)),
        at_samples=read_only(rows / at_samples[:, None]),
    )


def supports(rows: np.ndarray, shapes: np.ndarray, rounding: Any) -> np.ndarray:
    """Returns upper bounds of sqrt(g S g'), shape (..., r), for rows g, (..., r, n), and shapes S, (..., n, n).

    Computing g S g' is off by at most the rounding.
    """
    squares = ((rows @ shapes) * rows).sum(axis=-1)
    return np.sqrt(np.maximum(squares, 0.0) + rounding)
