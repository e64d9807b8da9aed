"""How far estimation error and disturbances reach around the predicted centers: it depends on Sigma_k alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shields.lookahead.prediction import Prediction
from shields.runtime.predicted_errors import predicted_errors


class Tightening(NamedTuple):
    """What errors and disturbances leave of the box and of S, for E error shapes (no first axis: a single one).

    Attributes:
        room: 1 - rho_j(c_i) less the rounding that does not depend on the estimate, shape (E, N, k) for the k rows c_i
            of the box; NaN for an unusable shape.
        weighting: T G, shape (E, N, n, n), with T of `PredictedErrors` after j steps: c_j is far enough inside S if
            |T G c_j| is at most the radius.
        radius: 1 - h less the rounding that does not depend on the estimate, shape (E, N); NaN for an unusable shape.
    """

    room: np.ndarray
    weighting: np.ndarray
    radius: np.ndarray


@np.errstate(all="ignore")  # what overflows leaves no room
def tightenings(prediction: Prediction, shapes: np.ndarray) -> Tightening:
    """Returns the exact support of what is reached at c_j, for every row of the box, and the end's ellipsoid.

    rho_j(a) = sqrt(a' A^j Sigma_k A^j' a) + sum_{i<j} sqrt(a' A^i D A^i' a), rounded outward: with |S_pq| <= s_p s_q a
    computed b'Sb is off by at most a relative rounding of (|b|'s)^2, the powers in b included.

    Args:
        prediction: Of the plant.
        shapes: Sigma_k, shape (E, n, n).
    """
    plant, rounding = prediction.plant, prediction.rounding[:, None]
    rows, sizes = plant.C @ prediction.free, np.abs(plant.C) @ prediction.size_free
    earlier = np.concatenate([plant.C[None], rows[:-1]])
    earlier_sizes = np.concatenate([np.abs(plant.C)[None], sizes[:-1]])
    disturbed = np.cumsum(_supports(earlier, earlier_sizes, plant.disturbance.shape[None], rounding)[0], axis=0)
    symmetric = 0.5 * (shapes + shapes.swapaxes(1, 2))
    reach = (_supports(rows, sizes, symmetric, rounding) + disturbed) * (1.0 + rounding)
    pushed = rounding * (prediction.size_forced @ np.abs(plant.C).T)
    nothing = np.empty((0, *shapes.shape[1:]))
    errors = [predicted_errors(end, shapes, nothing) for end in prediction.ends]
    radius = np.stack([each.radius for each in errors], axis=1)
    unusable = np.where(np.isnan(radius).any(axis=1), np.nan, 0.0)
    weightings = np.stack([each.weighting.transpose(2, 0, 1) for each in errors], axis=1) @ prediction.ends[0].root
    return Tightening(1.0 - reach - pushed + unusable[:, None, None], weightings, radius)


def _supports(rows: np.ndarray, sizes: np.ndarray, shapes: np.ndarray, rounding: np.ndarray) -> np.ndarray:
    """Returns upper bounds of sqrt(b'Sb) for rows b, shape (E, N, k).

    Args:
        rows: b, shape (N, k, n).
        sizes: |b| before any cancellation, shape (N, k, n).
        shapes: S, shape (E, n, n).
        rounding: Relative to products of absolute values, shape (N, 1).
    """
    extents = np.sqrt(np.abs(np.diagonal(shapes, axis1=1, axis2=2)))
    squares = ((rows @ shapes[:, None]) * rows).sum(axis=-1)
    size = (sizes @ extents[:, None, :, None])[..., 0]
    return np.sqrt(np.maximum(squares, 0.0) + rounding * size**2)
