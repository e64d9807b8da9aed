"""Compiled search for residuals that no error and no noise within their bounds explain."""

from __future__ import annotations

import numpy as np

from ncs_gym.compiled import entry


@entry
def are_outside(suspects, residuals, turns, values, limit, halvings, out):
    """Fills which residuals lie outside the sum of two ellipsoids; see `minkowski.outside_sum`.

    Args:
        suspects: Environment, edge and age of each, shape (k, 3).
        residuals: Shape (k, p).
        turns: Of the gain table, shape (edges, ages, p, p).
        values: Of the gain table, shape (edges, ages, p).
        limit: Square of what counts as outside.
        halvings: Of the share, at most.
        out: Filled, shape (k,).
    """
    p = residuals.shape[1]
    squares = np.empty(p)
    for k in range(out.size):
        edge, age = suspects[k, 1], suspects[k, 2]
        for i in range(p):
            turned = 0.0
            for j in range(p):
                turned += turns[edge, age, i, j] * residuals[k, j]
            squares[i] = turned * turned
        out[k] = _is_outside(squares, values[edge, age], limit, halvings)


@entry
def _is_outside(squares, values, limit, halvings):
    """Returns whether no share splits the residual into parts that lie in their ellipsoids."""
    low, high, outside = 0.0, 1.0, True
    for _ in range(halvings):
        share = 0.5 * (low + high)
        form = first = second = 0.0
        for i in range(squares.size):
            weight = share * (1.0 - share) / (values[i] * (1.0 - share) + share)
            form += squares[i] * weight
            first += squares[i] * values[i] * (weight / share) ** 2
            second += squares[i] * (weight / (1.0 - share)) ** 2
        outside = not form <= limit
        if outside or max(first, second) <= limit:
            return outside
        if first > second:
            low = share
        else:
            high = share
    return outside
