"""What the shield needs of an error ellipsoid E(Sigma_k), worked out once per distinct shape."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ncs_gym.uncertainty.shape_matrices import SMALLEST_MULTIPLIER, is_inside

if TYPE_CHECKING:
    from shields.runtime.one_step_test import OneStepTest

# With a smaller radius 1 - h, rounding of the weights would no longer be small against it.
SMALLEST_RADIUS = 1e-5
# An error shape may be indefinite by this fraction of its diagonal: rounding of flat ones.
INDEFINITE = 1e-9


class PredictedErrors(NamedTuple):
    """What follows from error shapes alone; the last axis counts them (no such axis: a single one).

    Attributes:
        weighting: T with |T z|^2 = sum_i (1-h) h / (h - p_i) z_i^2 along the axes of Sigma_pred, shape (n, n, k).
        radius: 1 - h less the rounding that does not depend on the estimate, shape (k,); NaN for an unusable shape.
        half_widths: Largest error of each state, shape (n, k); NaN for an unusable shape.
        largest: Bound of the largest error norm, sqrt(lambda_max(M Sigma_k)), shape (k,); NaN for an unusable shape.
        certified: Whether E(Sigma_k) lies inside a certified error set, shape (k,).
        shape: Sigma_k itself, shape (n, n, k); the filter keeps it in mode "lookahead" alone, else (0, n, k).
    """

    weighting: np.ndarray
    radius: Any
    half_widths: np.ndarray
    largest: Any
    certified: Any
    shape: np.ndarray

    def of(self, numbers: np.ndarray) -> PredictedErrors:
        """Returns those of environments that have the shapes with these numbers, shape (N,)."""
        return PredictedErrors(*(array.take(numbers, axis=-1) for array in self))

    def single(self) -> PredictedErrors:
        """Returns the first without a last axis."""
        weighting, half_widths, shape = (
            array[..., 0].copy() for array in (self.weighting, self.half_widths, self.shape)
        )
        radius, largest, certified = (array.item(0) for array in (self.radius, self.largest, self.certified))
        return PredictedErrors(weighting, radius, half_widths, largest, certified, shape)

    def batch(self) -> PredictedErrors:
        """Returns a single one as a batch of one."""
        return PredictedErrors(*(np.asarray(each)[..., None] for each in self))

    def followed_by(self, other: PredictedErrors) -> PredictedErrors:
        """Returns these shapes and then the others."""
        return PredictedErrors(*(np.concatenate(pair, axis=-1) for pair in zip(self, other, strict=True)))


@np.errstate(all="ignore")  # what overflows is found below, what underflows does not count
def predicted_errors(test: OneStepTest, shapes: np.ndarray, certified_shapes: np.ndarray) -> PredictedErrors:
    """Returns what the test and the guarantee need of error shapes (docs/shield_proof.md, "One step").

    Sigma_pred is the trace-smallest G (A Sigma_k A'/nu + D/(1-nu)) G', enlarged by the rounding of computing it.

    Args:
        test: The one-step test, in whose norm |z|_M = |G z| errors are measured.
        shapes: Sigma_k, shape (k, n, n).
        certified_shapes: Shapes of the certified error sets, shape (l, n, n).
    """
    symmetric = 0.5 * (shapes + shapes.swapaxes(1, 2))
    usable = _are_shapes(symmetric)
    inside = [
        bool(fine) and any(is_inside(S, Sigma) for Sigma in certified_shapes)
        for S, fine in zip(shapes, usable, strict=True)
    ]
    symmetric = np.where(usable[:, None, None], symmetric, np.eye(test.plant.n))
    half_widths = np.sqrt(np.diagonal(symmetric, axis1=1, axis2=2))
    identity = test.rounding * np.eye(test.plant.n)
    spread = half_widths @ test.columns
    moved = test.moved @ symmetric @ test.moved.T + (spread**2)[:, None, None] * identity
    second = np.trace(test.D) ** 0.5
    first = np.maximum(np.abs(np.trace(moved, axis1=1, axis2=2)) ** 0.5, SMALLEST_MULTIPLIER * second)[:, None, None]
    squares, axes = _eigh(moved * (1.0 + second / first) + test.D * (1.0 + first / second))
    h = np.sqrt(squares[:, -1])
    radius = 1.0 - h - test.rounding * (spread + test.pushed)
    weights = np.where(radius[:, None] >= SMALLEST_RADIUS, (h * (1.0 - h))[:, None] / (h[:, None] - squares), 1.0)
    weighting = np.sqrt(weights)[:, :, None] * axes.swapaxes(1, 2)
    own_spread = half_widths @ test.own_columns
    own = _eigh(test.root @ symmetric @ test.root.T)[0][:, -1] + test.rounding * own_spread**2
    usable &= np.all(np.isfinite(weighting), axis=(1, 2)) & np.isfinite(radius) & (h > 0.0)
    unusable = np.where(usable, 0.0, np.nan)
    return PredictedErrors(
        weighting=np.ascontiguousarray(np.where(usable[:, None, None], weighting, 0.0).transpose(1, 2, 0)),
        radius=radius + unusable,
        half_widths=np.ascontiguousarray((half_widths + unusable[:, None]).T),
        largest=np.sqrt(np.maximum(own, 0.0)) + unusable,
        certified=np.array(inside, np.bool_) & usable,
        shape=np.ascontiguousarray(shapes.transpose(1, 2, 0)),
    )


def _are_shapes(matrices: np.ndarray) -> np.ndarray:
    """Returns whether symmetric matrices (k, n, n) are finite and positive semidefinite up to rounding, shape (k,).

    Judged by the correlations S_ij / sqrt(S_ii S_jj), which do not depend on units.
    """
    widths = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    products = widths[:, :, None] * widths[:, None, :]
    possible = np.all(np.abs(matrices) <= (1.0 + INDEFINITE) * products, axis=(1, 2)) & np.all(widths < np.inf, axis=1)
    correlations = np.where(products > 0.0, matrices / products, 0.0)
    correlations = np.where(possible[:, None, None], correlations, 0.0)
    return possible & (_eigh(correlations)[0][:, 0] >= -INDEFINITE)


def _eigh(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns ascending eigenvalues (k, n) and eigenvectors (k, n, n); NaN where they cannot be computed."""
    finite = np.all(np.isfinite(matrices), axis=(1, 2))
    try:
        values, axes = np.linalg.eigh(np.where(finite[:, None, None], matrices, 0.0))
    except np.linalg.LinAlgError:
        return np.full(matrices.shape[:2], np.nan), np.full(matrices.shape, np.nan)
    return np.where(finite[:, None], values, np.nan), axes
