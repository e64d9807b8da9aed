"""Compiled solutions of many trust-region problems with the same matrix."""

from __future__ import annotations

import numpy as np

from ncs_gym.compiled import entry, inner

# Newton's method converges in about five steps, near the hard case in at most 25 of those that were tried.
MOST_STEPS = 40
# A step below this share of nu is rounding.
PRECISION = 1e-15
# A point whose squared length lacks more than this is in the hard case.
ENOUGH = 1e-9
# Problems that are solved together, in parallel lanes and a near cache.
LANES = 128


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
    n, count = values.size, out.shape[0]
    slope, rows, moving = np.empty((n, LANES)), np.empty((3, LANES)), np.empty(LANES, np.bool_)
    for start in range(0, count, LANES):
        lanes = min(LANES, count - start)
        for i in range(n):
            slope[i] = 0.0
            for j in range(n):
                share = inward[i, j]
                for k in range(lanes):
                    slope[i, k] += share * centers[start + k, j]
        _largest_roots(slope, values, lanes, rows[0], rows[1], rows[2], moving)
        _to_sphere(slope, values, lanes, rows[0], rows[1], rows[2])
        for i in range(n):
            for k in range(lanes):
                out[start + k, i] = 0.0
            for j in range(n):
                share = outward[i, j]
                for k in range(lanes):
                    out[start + k, i] += share * slope[j, k]


@inner
def _to_sphere(slope, values, lanes, root, length, square):
    """Turns slopes, shape (n, lanes), into points of length 1 at most; `length` and `square` are room for numbers."""
    n = values.size
    for k in range(lanes):
        length[k] = 0.0
    for i in range(n):
        for k in range(lanes):
            slope[i, k] /= root[k] - values[i]
            length[k] += slope[i, k] * slope[i, k]
    for i in range(n):
        for k in range(lanes):
            slope[i, k] = slope[i, k] if length[k] < np.inf else 0.0
    for k in range(lanes):
        square[k] = length[k] if length[k] < np.inf else 0.0
        last = slope[n - 1, k]
        slope[n - 1, k] = (
            np.copysign(np.sqrt(last * last + (1.0 - square[k])), last) if 1.0 - square[k] > ENOUGH else last
        )
        length[k] = 1.0 / np.sqrt(max(square[k], 1.0))
    for i in range(n):
        for k in range(lanes):
            slope[i, k] *= length[k]


@inner
def _largest_roots(slope, values, lanes, root, square, steepness, moving):
    """Fills `root` with nu >= max(values) such that sum (slope_i / (nu - value_i))^2 = 1, shape (lanes,).

    The norm as a function of nu is convex and falling, and so is its inverse concave: Newton on 1/norm from the left of
    the root rises monotonically and converges fast. Every term of the sum is at most 1, which is where it starts. A
    lane that has converged moves no more, so that it does not depend on the others.
    """
    n = values.size
    for k in range(lanes):
        square[k] = root[k] = 0.0
        moving[k] = True
    for i in range(n):
        for k in range(lanes):
            square[k] += slope[i, k] * slope[i, k]
            root[k] = max(root[k], values[i] + abs(slope[i, k]))
    for k in range(lanes):
        length = np.sqrt(square[k])
        root[k] = max(max(root[k], values[0] + length), values[n - 1] + 1e-12 * max(values[n - 1], length))
    for _ in range(MOST_STEPS):
        for k in range(lanes):
            square[k] = steepness[k] = 0.0
        for i in range(n):
            value = values[i]
            for k in range(lanes):
                inverse = 1.0 / (root[k] - value)
                share = slope[i, k] * inverse
                square[k] += share * share
                steepness[k] += share * share * inverse
        active = 0
        for k in range(lanes):
            step = square[k] * (np.sqrt(square[k]) - 1.0) / max(steepness[k], 1e-300)
            step = step if moving[k] & (square[k] > 1.0) else 0.0
            root[k] += step
            moving[k] = step > PRECISION * root[k]
            active += moving[k]
        if active == 0:
            break
