"""The test of plans: whether inputs keep every possible state in the box and end in the safe set."""

from __future__ import annotations

import numpy as np

from shields.lookahead.prediction import Prediction
from shields.lookahead.tightening import Tightening, tightenings
from shields.runtime.predicted_errors import SMALLEST_RADIUS

# Error shapes whose tightenings are remembered; they recur, since they depend only on what arrived when.
MOST_REMEMBERED = 4096


class PlanTest:
    """Whether a plan u_0..u_{j-1} is certified (docs/lookahead.md).

    With c_0 = x_hat and c_{i+1} = A c_i + B u_i it is if |c c_i| + rho_i(c) <= 1 for the rows c of the box and i =
    1..j-1, which is the exact condition for every possible x_{k+i} to lie in the box, and c_j + E(Sigma_pred,j) lies in
    S by the one-step test's condition. Then x_{k+j} is in S, hence in the box. For j = 1 it is the one-step test.

    Args:
        prediction: Of the plant.
        margin: By which the test must be passed, in units of the box and of S.

    Attributes:
        prediction: The same.
    """

    def __init__(self, prediction: Prediction, margin: float) -> None:
        self.prediction, self._margin = prediction, margin
        plant, ends = prediction.plant, prediction.ends
        self._rows = plant.C
        sizes = np.abs(plant.C) @ prediction.size_free
        self._row_rounding = (prediction.rounding[:, None, None] * sizes).reshape(-1, plant.n).T
        self._end_rounding = np.array([end.rounding * end.columns for end in ends]).T
        # Where in the table the tightenings of a shape are.
        self._remembered: dict[bytes, int] = {}
        self._table = tightenings(prediction, np.empty((0, plant.n, plant.n)))

    def tightenings_of(self, shapes: np.ndarray) -> Tightening:
        """Returns the tightenings of error shapes Sigma_k, shape (E, n, n); remembered, since shapes recur."""
        shapes = np.ascontiguousarray(shapes)
        keys = [shape.tobytes() for shape in shapes]
        new = {key: e for e, key in enumerate(keys) if key not in self._remembered}
        if len(self._remembered) + len(new) > MOST_REMEMBERED:
            self._remembered.clear()
            new = {key: e for e, key in enumerate(keys)}
        if new:
            found = tightenings(self.prediction, shapes[list(new.values())])
            known = [part[: len(self._remembered)] for part in self._table]
            self._table = Tightening(*(np.concatenate(pair) for pair in zip(known, found, strict=True)))
            self._remembered |= {key: len(self._remembered) + e for e, key in enumerate(new)}
        numbers = [self._remembered[key] for key in keys]
        return Tightening(*(part[numbers] for part in self._table))

    def tightening_alone(self, shape: np.ndarray) -> Tightening:
        """Returns what `tightenings_of` does for a single error shape, (n, n)."""
        number = self._remembered.get(shape.tobytes())
        if number is None:
            return Tightening(*(part[0] for part in self.tightenings_of(shape[None])))
        return Tightening(*(part[number] for part in self._table))

    @np.errstate(all="ignore")  # what is not finite is not certified
    def room(self, estimates: np.ndarray, tightening: Tightening) -> tuple[np.ndarray, np.ndarray]:
        """Returns the largest |c_i c_j|, shape (E, N, k), and |T G c_j|, shape (E, N), that pass; NaN for no usable.

        Of a single estimate, shape (n,), and a single tightening, without the first axis.
        """
        size = np.abs(estimates)
        rounding = (size @ self._row_rounding).reshape(tightening.room.shape)
        box = tightening.room - rounding - self._margin
        radius = tightening.radius - size @ self._end_rounding  # far below zero for estimates that are too far out
        return box, np.where(radius >= SMALLEST_RADIUS, radius - self._margin, np.nan)

    def judged(self, estimates: np.ndarray, tightening: Tightening, plans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns c_i c_j, shape (N, k, E, P), and T G c_j, shape (N, n, E, P): sums over long last axes are fast.

        Args:
            estimates: x_hat, shape (E, n).
            tightening: Of the error shapes of each.
            plans: Inputs, shape (E, P, N, m) [physical units].
        """
        centers = self.prediction.centers(estimates, plans)
        steps, n, count, number = centers.shape
        values = self._rows @ centers.reshape(steps, n, -1)
        weighting = tightening.weighting.transpose(1, 2, 3, 0)[..., None]
        weighted = weighting[:, :, 0] * centers[:, 0, None]
        for i in range(1, n):
            weighted += weighting[:, :, i] * centers[:, i, None]
        return values.reshape(steps, -1, count, number), weighted

    @np.errstate(all="ignore")
    def certified(self, estimates: np.ndarray, tightening: Tightening, plans: np.ndarray) -> np.ndarray:
        """Returns which first parts of plans are certified: those of 1..N inputs, shape (E, P, N).

        Args:
            estimates: x_hat, shape (E, n).
            tightening: Of the error shapes of each.
            plans: Inputs, shape (E, P, N, m) [physical units].
        """
        box, radius = self.room(estimates, tightening)
        values, weighted = self.judged(estimates, tightening, plans)
        kept = _kept(values, weighted, box.transpose(1, 2, 0)[..., None], radius.T[..., None])
        return kept.transpose(1, 2, 0) & self._within_limits(plans)

    @np.errstate(all="ignore")
    def certified_alone(self, estimate: np.ndarray, tightening: Tightening, plans: np.ndarray) -> np.ndarray:
        """Returns what `certified` does for one estimate, shape (n,), and its plans, (P, N, m): shape (P, N)."""
        box, radius = self.room(estimate, tightening)
        centers = self.prediction.centers_alone(estimate, plans)
        kept = _kept(self._rows @ centers, tightening.weighting @ centers, box[..., None], radius[:, None])
        return kept.T & self._within_limits(plans)

    def _within_limits(self, plans: np.ndarray) -> np.ndarray:
        """Returns whether the first j inputs of plans, shape (..., N, m), are within the limits, shape (..., N)."""
        allowed = np.all(np.abs(plans) <= self.prediction.plant.u_max, axis=-1)
        return np.logical_and.accumulate(allowed, axis=-1)

    @np.errstate(all="ignore")
    def knows_in_box(self, estimate: np.ndarray, error_shape: np.ndarray) -> bool:
        """Returns whether |c_i x_hat| + sqrt(c_i Sigma_k c_i') <= 1 for all rows, which proves that x is in the box."""
        rows, extents = self.prediction.plant.C, np.sqrt(np.diag(error_shape))
        rounding = float(self.prediction.rounding[0])
        size = np.abs(rows) @ extents
        reach = np.sqrt(np.maximum(((rows @ error_shape) * rows).sum(axis=1), 0.0) + rounding * size**2)
        reach = reach + np.abs(rows @ estimate) + rounding * (np.abs(rows) @ np.abs(estimate))
        return bool((reach <= 1.0 - self._margin).all())


def _kept(values: np.ndarray, weighted: np.ndarray, box: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Returns whether centers c_1..c_{j-1} are far enough inside the box, and c_j inside S, shape (N, ...).

    Args:
        values: c_i c_j, shape (N, k, ...) with axes of estimates and plans last, as in all others.
        weighted: T G c_j, shape (N, n, ...).
        box: Largest |c_i c_j|, shape (N, k, ...).
        radius: Largest |T G c_j|, shape (N, ...).
    """
    inside = np.all(np.abs(values) <= box, axis=1)
    kept = np.asarray(np.sqrt((weighted * weighted).sum(axis=1)) <= radius)
    kept[1:] &= np.logical_and.accumulate(inside[:-1], axis=0)
    return kept
