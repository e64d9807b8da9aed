"""Compiled Newton iterations for many trust-region problems with the same matrix."""

from __future__ import annotations

import numpy as np

from ncs_gym.compiled import entry

# Newton's method converges in about six steps; these are never all needed.
MOST_STEPS = 40
# A step below this share of nu is rounding.
PRECISION = 1e-15


@entry
def fill_largest_roots(slopes, values, nu):
    """Fills nu >= max(values) with sum (slope_i / (nu - value_i))^2 = 1 for each row of slopes, shape (count, n).

    The norm as a function of nu is convex and falling, and so is its inverse concave: Newton on 1/norm from the left of
    the root rises monotonically and converges fast.

    Args:
        slopes: Shape (count, n).
        values: Ascending, shape (n,).
        nu: Filled, shape (count,).
    """
    n = values.size
    for k in range(nu.size):
        length = 0.0
        for i in range(n):
            length += slopes[k, i] * slopes[k, i]
        root = values[n - 1] + max(abs(slopes[k, n - 1]), 1e-12 * max(values[n - 1], np.sqrt(length)))
        for _ in range(MOST_STEPS):
            square = slope = 0.0
            for i in range(n):
                gap = root - values[i]
                term = (slopes[k, i] / gap) ** 2
                square += term
                slope += term / gap
            if not square > 1.0:
                break
            step = square * (np.sqrt(square) - 1.0) / max(slope, 1e-300)
            root += step
            if not step > PRECISION * root:
                break
        nu[k] = root
