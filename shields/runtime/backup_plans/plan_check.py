"""Which backup plans are certified: inputs that keep every possible state in the box and end in the safe set, S or P.

`Prediction` says what the plant does within N steps, `Tightening` how far errors and disturbances reach around that,
and `PlanTest` decides. Arrays count environments on their first axis.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym.ellipsoid import SMALLEST_MULTIPLIER
from ncs_gym.validation import read_only
from shields.runtime.set_test import SMALLEST_RADIUS, SetTest, ball, closed, judged_shapes, supports

# Error shapes whose tightenings are remembered; they recur, since they depend only on what arrived when. Fewer where
# those of one are many numbers.
MOST_REMEMBERED, MOST_NUMBERS = 4096, 10_000_000
# Entries of an array that are worked on together.
BLOCK = 1_000_000
# What a row may exceed its limit by, in units of the box, before no plan is looked for: far more than rounding.
SLACK = 1e-9


class PlanTest:
    """Whether a plan u_0..u_{j-1} is certified (docs/lookahead.md).

    With c_0 = x_hat and c_{i+1} = A c_i + B u_i it is if low + rho_i(c) <= c c_i <= high - rho_i(c) for the rows c of
    the box and i = 1..j-1, which is the exact condition for every possible x_{k+i} to lie in the box, and c_j +
    E(Sigma_pred,j) lies in S by the one-step test's condition; where S is a polytope P, the same of g c_j
    for the rows g of P, which is exact, too. Then x_{k+j} is in S or P, hence in the box. For j = 1 it is the
    one-step test.

    Its methods take estimates x_hat of E environments, shape (E, n), the tightening of the error shape of each, and P
    plans for each, shape (E, P, N, m) [physical units].

    Args:
        prediction: Of the plant.
        margin: By which the test must be passed, in units of the box and of S or P.
    """

    def __init__(self, prediction: Prediction, margin: float) -> None:
        self.prediction, self._margin = prediction, margin
        plant, ends = prediction.plant, prediction.ends
        self._row_rounding = prediction.rounding[:, None, None] * (np.abs(prediction.rows) @ prediction.sizes[1:])
        roundings = [end.rounding * end.columns for end in ends] or np.zeros((prediction.steps, plant.n))
        self._end_rounding = np.array(roundings).T
        # Of rows at every step: what estimate and first input do, shape (n + m, N, r), and what later inputs may do.
        effects = prediction.rows @ prediction.forced
        first, later = effects[..., : plant.m], effects[..., plant.m :]
        by_first = np.concatenate([prediction.rows @ prediction.powers[1:], first], axis=2)
        self._by_first = np.ascontiguousarray(by_first.transpose(2, 0, 1))
        self._by_others = later @ np.tile(plant.input_middle, prediction.steps - 1) - prediction.middle
        self._reach_of_others = np.abs(later) @ np.tile(plant.input_half, prediction.steps - 1) + SLACK
        self._most = min(MOST_REMEMBERED, max(1, MOST_NUMBERS // (prediction.steps * len(prediction.rows))))
        # Tightenings, and where among them those of a shape are: both are replaced together and never written into,
        # since threads share them.
        self._known: tuple[dict[bytes, int], Tightening] = {}, tightenings(prediction, np.empty((0, plant.n, plant.n)))

    def tightenings_of(self, shapes: np.ndarray) -> Tightening:
        """Returns the tightenings of error shapes Sigma_k, shape (E, n, n); remembered, since shapes recur."""
        shapes = np.ascontiguousarray(shapes)
        keys, (numbers, table) = [shape.tobytes() for shape in shapes], self._known
        new = {key: e for e, key in enumerate(keys) if key not in numbers}
        if len(numbers) + len(new) > self._most:
            numbers, table, new = {}, table.some(slice(0)), {key: e for e, key in enumerate(keys)}
        if new:
            found = tightenings(self.prediction, shapes[list(new.values())])
            table = Tightening(*(np.concatenate(pair) for pair in zip(table, found, strict=True)))
            numbers = numbers | {key: len(numbers) + e for e, key in enumerate(new)}
            self._known = numbers, table
        return table.some([numbers[key] for key in keys])

    def limits_at(self, estimates: np.ndarray, tightening: Tightening) -> tuple[np.ndarray, np.ndarray]:
        """Returns the largest |row c_j - middle|, shape (E, N, r), and |T G c_j|, shape (E, N), that pass.

        Both are NaN if unknown.
        """
        return self._row_limits(estimates, tightening, slice(None)), self._radius(estimates, tightening)

    def _row_limits(self, estimates: np.ndarray, tightening: Tightening, rows: slice) -> np.ndarray:
        limits, rounding = tightening.row_limits[:, :, rows], self._row_rounding[:, rows]
        size = np.abs(estimates) @ rounding.reshape(-1, estimates.shape[1]).T
        return limits - size.reshape(limits.shape) - self._margin

    def _radius(self, estimates: np.ndarray, tightening: Tightening) -> np.ndarray:
        radius = tightening.radius - np.abs(estimates) @ self._end_rounding  # may be far below zero
        return np.where(radius >= SMALLEST_RADIUS, radius - self._margin, np.nan)

    def may_begin(self, estimates: np.ndarray, tightening: Tightening, firsts: np.ndarray) -> np.ndarray:
        """Returns where a plan may begin with an input, (E, m); shape (E,).

        Elsewhere none is certified: some row, on the way or at every end, is beyond its limit whatever inputs follow.
        """
        both, k = np.concatenate([estimates, firsts], axis=1), len(self.prediction.plant.box)
        in_box = self._may_keep(both, estimates, tightening, slice(k))
        ends = np.ones_like(in_box)
        np.logical_and.accumulate(in_box[:, :-1], axis=1, out=ends[:, 1:])
        if not self.prediction.ends:
            ends &= in_box & self._may_keep(both, estimates, tightening, slice(k, None))
        return np.any(ends, axis=1)

    def _may_keep(self, both: np.ndarray, estimates: np.ndarray, tightening: Tightening, rows: slice) -> np.ndarray:
        """Returns whether each of some rows is within its limits at every step for some later inputs, (E, N)."""
        others, matrix = self._by_others[:, rows], self._by_first[:, :, rows]
        values = (both @ matrix.reshape(len(matrix), -1)).reshape(len(both), *others.shape)
        limits = self._row_limits(estimates, tightening, rows) + self._reach_of_others[:, rows]
        return np.all(np.abs(values + others) <= limits, axis=2)

    def certified(self, estimates: np.ndarray, tightening: Tightening, plans: np.ndarray) -> np.ndarray:
        """Returns which first parts of plans are certified: those of 1..N inputs, shape (E, P, N)."""
        block = max(1, BLOCK // (plans[:1, ..., 0].size * len(self.prediction.rows) or 1))
        if len(plans) > block:
            parts = [slice(start, start + block) for start in range(0, len(plans), block)]
            found = [self.certified(estimates[e], tightening.some(e), plans[e]) for e in parts]
            return np.concatenate(found)
        prediction, plant = self.prediction, self.prediction.plant
        centers, k = prediction.centers(estimates, plans), len(plant.box)
        in_box = self._between(estimates, tightening, centers, slice(k))
        if prediction.ends:
            kept = self._in_cone(estimates, tightening, centers)
        else:
            kept = in_box & self._between(estimates, tightening, centers, slice(k, None))
        on_the_way = np.ones_like(in_box)
        np.logical_and.accumulate(in_box[:-1], axis=0, out=on_the_way[1:])
        kept &= on_the_way
        if tightening.between.size:
            kept &= prediction.within.keeps(estimates, tightening.between, plans, self._margin)
        within = np.all((plant.input_ends[0] <= plans) & (plans <= plant.input_ends[1]), axis=-1)
        return np.logical_and.accumulate(within, axis=-1) & kept.transpose(1, 2, 0)

    def _between(self, estimates: np.ndarray, tightening: Tightening, centers: np.ndarray, rows: slice) -> np.ndarray:
        """Returns whether some rows keep their limits at the centers, shape (N, E, P)."""
        of_rows = self.prediction.rows[rows]
        # Sums over long last axes are fast.
        values = (of_rows @ centers.reshape(*centers.shape[:2], -1)).reshape(len(centers), -1, *centers.shape[2:])
        values -= self.prediction.middle[rows, None, None]
        limits = self._row_limits(estimates, tightening, rows)
        return np.all(np.abs(values, out=values) <= limits.transpose(1, 2, 0)[..., None], axis=1)

    def _in_cone(self, estimates: np.ndarray, tightening: Tightening, centers: np.ndarray) -> np.ndarray:
        """Returns whether |T G c_j| keeps its limit at the centers, shape (N, E, P)."""
        weighting = tightening.weighting.transpose(1, 2, 3, 0)[..., None]
        weighted = weighting[:, :, 0] * centers[:, 0, None]
        for i in range(1, centers.shape[1]):
            weighted += weighting[:, :, i] * centers[:, i, None]
        radius = self._radius(estimates, tightening)
        return np.sqrt((weighted * weighted).sum(axis=1)) <= radius.T[..., None]

    def knows_in_box(self, estimate: np.ndarray, error_shape: np.ndarray) -> bool:
        """Returns whether c_i x_hat +- sqrt(c_i Sigma_k c_i') is between all ends: x is in the box then."""
        count, extents = len(self.prediction.plant.box), np.sqrt(np.diag(error_shape))
        rows, middle = self.prediction.rows[:count], self.prediction.middle[:count]
        rounding = float(self.prediction.rounding[0])
        reach = supports(rows, error_shape, rounding * (np.abs(rows) @ extents) ** 2)
        reach = reach + np.abs(rows @ estimate - middle) + rounding * (np.abs(rows) @ np.abs(estimate))
        return bool((reach <= self.prediction.half[:count] - self._margin).all())


class Prediction:
    """The centers c_0 = x_hat, c_{j+1} = A c_j + B u_j of the states that can be reached, j = 1..N.

    Products in float64 are off by at most `rounding` times the same products of absolute values: powers of A take j
    roundings of n-term sums, the sum over the inputs m terms per step.

    Args:
        first: The one-step test, which gives the plant and the norm of S, or the rows of P.
        steps: N.

    Attributes:
        plant: The plant.
        steps: N.
        rows: Rows whose values at the centers are judged, shape (r, n): the k rows of the box, and where plans end in P
            its others.
        middle, half: Of the ends of these rows, shape (r,); the half is less by the rounding of both.
        within: What is asked within steps.
        powers, sizes: A^j and |A|^j for j = 0..N, shape (N + 1, n, n).
        forced: Block rows [A^{j-1} B, ..., B, 0, ...], shape (N, n, N m).
        size_forced: sum_{i<j} |A|^i |B| |u| for the largest |u| within the limits, shape (N, n).
        rounding: Relative rounding after j steps, shape (N,).
        cone: The root of S, shape (n, n); of shape (0, n) where plans end in P.
        ends: Whether c_j + E(Sigma_pred,j) lies in S, for N lengths of a plan; none where plans end in P.
    """

    def __init__(self, first: SetTest, steps: int) -> None:
        plant, n, m = first.plant, first.plant.n, first.plant.m
        self.plant, self.steps = plant, steps
        self.cone, ends_in = first.root[: first.cone], first.root[first.cone :]
        k = len(plant.box)
        self.rows = np.concatenate([plant.box, ends_in[k:]])
        low, high = closed(*plant.kept_ends)
        middle, half = first.middle[k : len(ends_in)], first.half[k : len(ends_in)]
        self.middle = read_only(np.concatenate([0.5 * (low + high), middle]))
        rounding = first.rounding * np.abs(self.middle[:k])
        self.half = read_only(np.concatenate([0.5 * (high - low) - rounding, half]))
        powers, sizes = [np.eye(n)], [np.eye(n)]
        for _ in range(steps):
            powers.append(plant.A @ powers[-1])
            sizes.append(np.abs(plant.A) @ sizes[-1])
        self.powers, self.sizes = read_only(np.array(powers)), read_only(np.array(sizes))
        effects = np.array([power @ plant.B for power in powers[:-1]])
        forced = np.zeros((steps, n, steps, m))
        for j in range(steps):
            forced[j, :, : j + 1] = effects[j::-1].transpose(1, 0, 2)
        self.forced = read_only(forced.reshape(steps, n, steps * m))
        pushes = np.array([size @ np.abs(plant.B) @ plant.largest_input for size in sizes[:-1]])
        self.size_forced = read_only(np.cumsum(pushes, axis=0))
        self.rounding = read_only(8.0 * (n + m) * (np.arange(1, steps + 1) + 2.0) * float(np.finfo(float).eps))
        self.ends = tuple(End.after(j + 1, self) for j in range(steps)) if first.cone else ()
        self.within = RowsWithinSteps(self)
        self._free = self.powers[1:].reshape(steps * n, n)
        self._forced = self.forced.reshape(steps * n, steps * m)

    def centers(self, estimates: np.ndarray, plans: np.ndarray) -> np.ndarray:
        """Returns c_1..c_N, shape (N, n, E, P), of P plans for each of E estimates; for shapes see `PlanTest`."""
        count, number = plans.shape[:2]
        pushed = (self._forced @ plans.reshape(count * number, -1).T).reshape(-1, count, number)
        moved = (self._free @ estimates.T)[..., None] + pushed
        return moved.reshape(self.steps, self.plant.n, count, number)


class RowsWithinSteps:
    """The plant's `step_rows` in every step of a plan, i = 0..N-1: row (c_i, u_i) +- rho_i is between its ends.

    Attributes:
        free: Rows on x_hat, shape (N, g, n).
        forced: Rows on a plan, shape (N, g, N m).
        middle: Of the ends of these rows, shape (g,).
    """

    def __init__(self, prediction: Prediction) -> None:
        plant, steps, m, n = prediction.plant, prediction.steps, prediction.plant.m, prediction.plant.n
        of_state, of_input = np.hsplit(plant.step_rows, [n])
        size, self._rounding = np.abs(of_state), prediction.rounding
        self.free = read_only(of_state @ prediction.powers[:-1])
        self._size = read_only(size @ prediction.sizes[:-1])
        forced = of_state @ np.concatenate([np.zeros((1, n, steps * m)), prediction.forced[:-1]])
        for i in range(steps):
            forced[i, :, i * m : (i + 1) * m] += of_input
        self.forced = read_only(forced)
        pushed = np.concatenate([np.zeros((1, n)), prediction.size_forced[:-1]]) @ size.T
        self._pushed = read_only(pushed + np.abs(of_input) @ plant.largest_input)
        low, high = closed(*plant.step_ends)
        self.middle = read_only(0.5 * (low + high))
        self._half = read_only(0.5 * (high - low) - float(self._rounding[0]) * np.abs(self.middle))
        D = plant.disturbance.shape_matrix
        own = _supports(self.free, self._size, D[None], self._rounding[:, None])[0]
        self._disturbed = read_only(np.concatenate([np.zeros_like(own[:1]), np.cumsum(own[:-1], axis=0)]))

    def row_limits(self, shapes: np.ndarray) -> np.ndarray:
        """Returns half the range less rho_i and rounding that is no estimate's, (E, N, g), for shapes (E, n, n)."""
        rounding = self._rounding[:, None]
        reach = _supports(self.free, self._size, shapes, rounding) + self._disturbed
        return self._half - reach * (1.0 + rounding) - rounding * self._pushed

    def keeps(self, estimates: np.ndarray, row_limits: np.ndarray, plans: np.ndarray, margin: float) -> np.ndarray:
        """Returns whether limits within the first i+1 steps are kept by a margin, shape (N, E, P)."""
        steps, g, n = self.free.shape
        count, number = plans.shape[:2]
        rounding = np.abs(estimates) @ (self._rounding[:, None, None] * self._size).reshape(-1, n).T
        left = row_limits - rounding.reshape(count, steps, g)
        values = (self.forced.reshape(steps * g, -1) @ plans.reshape(count * number, -1).T).reshape(-1, count, number)
        values += (self.free.reshape(-1, n) @ estimates.T)[..., None]
        values -= np.tile(self.middle, steps)[:, None, None]
        inside = np.abs(values.reshape(steps, g, count, number)) <= left.transpose(1, 2, 0)[..., None] - margin
        return np.logical_and.accumulate(inside.all(axis=1), axis=0)


class End(NamedTuple):
    """The cone of the one-step test for the plant that takes j steps at once: A^j, and what disturbances add up to.

    Attributes:
        moved: G A^j, shape (n, n).
        D: What disturbances add up to, in the coordinates of G, shape (n, n).
        columns: Norms of the columns of |G| |A|^j, shape (n,).
        pushed: Bound of the norm of |G| times what the inputs of these steps do.
        rounding: Relative to the products of absolute values.
    """

    moved: np.ndarray
    D: np.ndarray
    columns: np.ndarray
    pushed: float
    rounding: float

    @classmethod
    def after(cls, steps: int, prediction: Prediction) -> End:
        """Returns the cone after j steps.

        E(Q_1) + ... + E(Q_j) lies inside E(sum_i Q_i / w_i) for weights w_i > 0 of sum 1; w_i proportional to
        sqrt(tr Q_i) makes the trace smallest, also together with the estimation error that `ball` adds.
        """
        plant, cone = prediction.plant, prediction.cone
        n, m, size = plant.n, plant.m, np.abs(prediction.cone)
        rounding = float((16.0 * (n + m) * (steps + 2) + 4.0 * n * n) * np.finfo(float).eps)
        extents = np.sqrt(np.diag(plant.disturbance.shape_matrix))
        parts = []
        for power, reach in zip(prediction.powers[:steps], prediction.sizes[:steps], strict=True):
            root = cone @ power
            own = rounding * float(np.linalg.norm(size @ reach, axis=0) @ extents) ** 2
            parts.append(root @ plant.disturbance.shape_matrix @ root.T + own * np.eye(n))
        widths = np.sqrt([np.trace(part) for part in parts])
        widths = np.maximum(widths, SMALLEST_MULTIPLIER * widths.max())
        D = sum(part * (widths.sum() / width) for part, width in zip(parts, widths, strict=True))
        D = (1.0 + rounding) * np.asarray(D)
        return cls(
            moved=read_only(cone @ prediction.powers[steps]),
            D=read_only(0.5 * (D + D.T)),
            columns=read_only(np.linalg.norm(size @ prediction.sizes[steps], axis=0)),
            pushed=float(np.linalg.norm(size @ prediction.size_forced[steps - 1])),
            rounding=rounding,
        )

    def ball(self, symmetric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns T and the radius of `ball` for error shapes, (k, n, n)."""
        spread = np.sqrt(np.diagonal(symmetric, axis1=1, axis2=2)) @ self.columns
        return ball(self.moved, self.D, symmetric, spread, self.pushed, self.rounding)


class Tightening(NamedTuple):
    """What errors and disturbances leave of the box and of S or P, for E error shapes.

    Attributes:
        row_limits: Half the range of a row less rho_j(row) and the rounding that does not depend on the estimate, shape
            (E, N, r) for the rows of the `Prediction`; NaN for an unusable shape.
        weighting: T G, shape (E, N, n, n), with T of `PredictedErrors` after j steps: c_j is far enough inside S if
            |T G c_j| is at most the radius. Of shape (E, N, 0, n) where plans end in P.
        radius: 1 - h less the rounding that does not depend on the estimate, shape (E, N); 1 where plans end in P; NaN
            for an unusable shape.
        between: `RowsWithinSteps.row_limits`, shape (E, N, g).
    """

    row_limits: np.ndarray
    weighting: np.ndarray
    radius: np.ndarray
    between: np.ndarray

    def some(self, chosen: Any) -> Tightening:
        """Returns those of some error shapes, given by their numbers."""
        return Tightening(*(part[chosen] for part in self))


def tightenings(prediction: Prediction, shapes: np.ndarray) -> Tightening:
    """Returns the exact support of what is reached at c_j, for every row, and the end's ellipsoid.

    rho_j(a) = sqrt(a' A^j Sigma_k A^j' a) + sum_{i<j} sqrt(a' A^i D A^i' a), rounded outward: with |S_pq| <= s_p s_q a
    computed b'Sb is off by at most a relative rounding of (|b|'s)^2, the powers in b included. Shapes are (E, n, n).
    """
    plant, rounding = prediction.plant, prediction.rounding[:, None]
    rows, sizes = prediction.rows @ prediction.powers, np.abs(prediction.rows) @ prediction.sizes
    added = _supports(rows[:-1], sizes[:-1], plant.disturbance.shape_matrix[None], rounding)[0]
    symmetric = 0.5 * (shapes + shapes.swapaxes(1, 2))
    reach = (_supports(rows[1:], sizes[1:], symmetric, rounding) + np.cumsum(added, axis=0)) * (1.0 + rounding)
    pushed = rounding * (prediction.size_forced @ np.abs(prediction.rows).T)
    between = prediction.within.row_limits(symmetric)
    judged, usable, _ = judged_shapes(shapes, shapes[:0])
    if prediction.ends:
        found = [end.ball(judged) for end in prediction.ends]
        radius = np.stack([each[1] for each in found], axis=1)
        weightings = np.stack([each[0] for each in found], axis=1) @ prediction.cone
    else:
        radius, usable = np.ones((len(shapes), prediction.steps)), usable & np.isfinite(reach).all(axis=(1, 2))
        weightings = np.empty((*radius.shape, 0, plant.n))
    radius = radius + np.where(usable, 0.0, np.nan)[:, None]
    return Tightening(
        row_limits=prediction.half
        - reach
        - pushed
        + np.where(np.isnan(radius).any(axis=1), np.nan, 0.0)[:, None, None],
        weighting=np.where(np.isnan(radius)[..., None, None], 0.0, weightings),
        radius=radius,
        between=between,
    )


def _supports(rows: np.ndarray, sizes: np.ndarray, shapes: np.ndarray, rounding: np.ndarray) -> np.ndarray:
    """Returns upper bounds of sqrt(b'Sb) for rows b, (N, k, n), and shapes S, (E, n, n): shape (E, N, k).

    Sizes are |b| before any cancellation, the rounding, (N, 1), is relative to products of absolute values.
    """
    extents = np.sqrt(np.abs(np.diagonal(shapes, axis1=1, axis2=2)))
    size = (sizes @ extents[:, None, :, None])[..., 0]
    return supports(rows, shapes[:, None], rounding * size**2)
