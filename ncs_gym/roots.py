"""Compiled solutions of many trust-region problems with the same matrix."""

from __future__ import annotations

import numpy as np

from ncs_gym.compiled import entry

# Newton's method converges in about six steps; these are never all needed.
MOST_STEPS = 40
# A step below this share of nu is rounding.
PRECISION = 1e-15
# A point whose squared length lacks more than this is in the hard case.
ENOUGH = 1e-9


@entry
def fill_farthest(centers, inward, values, outward, out):
    """Fills the points outward s, |s| <= 1, that maximize s' diag(values) s + 2 (inward center)'s, shapes (count, n).

    A solution is s_i = slope_i / (nu - value_i) with nu >= max(values) and |s| = 1; in the "hard case" (no pull along
    the longest axis) that axis takes what is missing to length 1.

    Args:
        centers: Shape (count, n).
        inward: Shape (n, n).
        values: Ascending, shape (n,).
        outward: Shape (n, n).
        out: Filled, shape (count, n).
    """
    n = values.size
    slope, point = np.empty(n), np.empty(n)
    for k in range(out.shape[0]):
        for i in range(n):
            slope[i] = 0.0
            for j in range(n):
                slope[i] += inward[i, j] * centers[k, j]
        root, length = _largest_root(slope, values), 0.0
        for i in range(n):
            point[i] = slope[i] / (root - values[i])
            length += point[i] * point[i]
        if not np.isfinite(length):
            point[:] = 0.0
            length = 0.0
        if 1.0 - length > ENOUGH:
            point[n - 1] = np.copysign(np.sqrt(point[n - 1] ** 2 + 1.0 - length), point[n - 1])
            length = 1.0
        shrink = 1.0 / np.sqrt(max(length, 1.0))
        for i in range(n):
            out[k, i] = 0.0
            for j in range(n):
                out[k, i] += outward[i, j] * (shrink * point[j])


@entry
def _largest_root(slope, values):
    """Returns nu >= max(values) with sum (slope_i / (nu - value_i))^2 = 1.

    The norm as a function of nu is convex and falling, and so is its inverse concave: Newton on 1/norm from the left of
    the root rises monotonically and converges fast.
    """
    n, length = values.size, 0.0
    for i in range(n):
        length += slope[i] * slope[i]
    root = values[n - 1] + max(abs(slope[n - 1]), 1e-12 * max(values[n - 1], np.sqrt(length)))
    for _ in range(MOST_STEPS):
        square = steepness = 0.0
        for i in range(n):
            gap = root - values[i]
            term = (slope[i] / gap) ** 2
            square += term
            steepness += term / gap
        if not square > 1.0:
            break
        step = square * (np.sqrt(square) - 1.0) / max(steepness, 1e-300)
        root += step
        if not step > PRECISION * root:
            break
    return root
