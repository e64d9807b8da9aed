"""Products of a small matrix with many vectors; the last axis of every array is the vector.

Compiled leaves take bare arrays and index them whole: numba counts references of every view and tuple it makes.
"""

from __future__ import annotations

import numpy as np

from ncs_gym.compiled import inner


@inner
def copy_rows(x, out):
    """Fills out = x, shapes (n, N)."""
    for i in range(x.shape[0]):
        for e in range(x.shape[1]):
            out[i, e] = x[i, e]


@inner
def hold_rows(farthest, x):
    """Stops the rows of x, shape (n, N), at `farthest`, shape (n,)."""
    for i in range(x.shape[0]):
        if farthest[i] < np.inf:
            for e in range(x.shape[1]):
                x[i, e] = min(max(x[i, e], -farthest[i]), farthest[i])


@inner
def set_product(matrix, x, out):
    """Fills out = matrix x, shapes (k, n), (n, N) and (k, N); out is not x."""
    for i in range(out.shape[0]):
        if matrix.shape[1] == 1:
            share = matrix[i, 0]
            for e in range(out.shape[1]):
                out[i, e] = share * x[0, e]
        else:
            one, other = matrix[i, 0], matrix[i, 1]
            for e in range(out.shape[1]):
                out[i, e] = one * x[0, e] + other * x[1, e]
    _add_columns(matrix, 2, x, out)


@inner
def add_product(matrix, x, out):
    """Adds matrix x to out, shapes (k, n), (n, N) and (k, N); out is not x."""
    _add_columns(matrix, 0, x, out)


@inner
def _add_columns(matrix, first, x, out):
    """Adds what columns of a matrix from `first` on contribute, two at a time, but for pairs of zeros."""
    for i in range(out.shape[0]):
        for j in range(first, matrix.shape[1] - 1, 2):
            one, other = matrix[i, j], matrix[i, j + 1]
            if one != 0.0 or other != 0.0:
                for e in range(out.shape[1]):
                    out[i, e] += one * x[j, e] + other * x[j + 1, e]
        if (matrix.shape[1] - first) % 2 == 1 and matrix.shape[1] > first:
            last = matrix.shape[1] - 1
            share = matrix[i, last]
            for e in range(out.shape[1]):
                out[i, e] += share * x[last, e]
