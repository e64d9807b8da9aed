"""Fits of matrices and ellipsoids to sampled steps."""

from __future__ import annotations

import numpy as np

from ncs_gym.uncertainty.shape_matrices import rounded_up

# Rounds of reweighting: the largest remainder settles to about a percent.
ROUNDS = 60
# The ellipsoid around the samples is at most this much larger than the smallest one, in squared radii.
EXCESS = 0.01
MOST_UPDATES = 10_000
# Directions in which less than this fraction of the largest extent is left out, mostly by rounding, get that much.
THINNEST = 1e-4
# No sample loses all of its weight.
SMALLEST_WEIGHT = 1e-9
# Results keep this many digits, so that other machines find the same numbers.
DIGITS = 9


def fitted_matrices(
    states: np.ndarray, inputs: np.ndarray, moved: np.ndarray, widths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns A and B for which the largest remainder of the samples, in half-widths of the box, is nearly smallest.

    Lawson's algorithm: least squares again and again, each sample weighted with its remainders so far.

    Args:
        states: Shape (n, N).
        inputs: Shape (m, N).
        moved: Next states, shape (n, N).
        widths: Half-widths of the box, shape (n,).
    """
    regressors = np.concatenate([states, inputs]).T
    targets = (moved / widths[:, None]).T
    weights, best, smallest = np.ones(len(targets)), None, np.inf
    for _ in range(ROUNDS):
        root = np.sqrt(weights)[:, None]
        matrix = np.linalg.lstsq(root * regressors, root * targets, rcond=None)[0]
        sizes = np.linalg.norm(targets - regressors @ matrix, axis=1)
        if sizes.max() < smallest:
            best, smallest = matrix, sizes.max()
        weights = weights * (sizes + SMALLEST_WEIGHT * sizes.max() + np.finfo(float).tiny)
        weights /= weights.sum()
    if best is None:
        raise ValueError("the sampled steps are not finite: no linear model fits them")
    fitted = np.round(best * widths, DIGITS).T
    return fitted[:, : len(states)], fitted[:, len(states) :]


def surrounding_shape(points: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Returns P, shape (n, n), of nearly the smallest ellipsoid E(P) around points and their negatives.

    Khachiyan's algorithm in the principal axes of the points; an axis without extent gets a little of it.

    Args:
        points: Shape (N, n).
        widths: Half-widths of the box, shape (n,): the unit of each entry.
    """
    scaled = points / widths
    if not np.any(scaled):
        return np.zeros((len(widths), len(widths)))
    axes = np.linalg.svd(scaled, full_matrices=False)[2]
    coordinates = scaled @ axes.T
    extents = np.abs(coordinates).max(axis=0)
    extents = np.maximum(extents, THINNEST * extents.max())
    whitened = np.concatenate([coordinates / extents, np.eye(len(widths))])
    n, weights = len(widths), np.full(len(whitened), 1.0 / len(whitened))
    for _ in range(MOST_UPDATES):
        moments = whitened.T @ (weights[:, None] * whitened)
        sizes = np.einsum("ij,jk,ik->i", whitened, np.linalg.inv(moments), whitened)
        farthest = int(sizes.argmax())
        if sizes[farthest] <= n * (1.0 + EXCESS):
            break
        step = (sizes[farthest] / n - 1.0) / (sizes[farthest] - 1.0) if n > 1 else 1.0
        weights *= 1.0 - step
        weights[farthest] += step
    moments = whitened.T @ (weights[:, None] * whitened)
    sizes = np.einsum("ij,jk,ik->i", whitened, np.linalg.inv(moments), whitened)
    factor = widths[:, None] * axes.T * extents
    return rounded_up(sizes.max() * factor @ moments @ factor.T, DIGITS)
