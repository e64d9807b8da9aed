"""Products of a small matrix with many vectors; the last axis of every array is the vector.

Compiled leaves take bare arrays and index them whole: numba counts references of every view and tuple it makes.
"""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def copy_rows(x, out):
    """Fills out = x, shapes (n, N)."""
    for i in range(x.shape[0]):
        for e in range(x.shape[1]):
            out[i, e] = x[i, e]


@njit(cache=True, nogil=True, error_model="numpy")
def set_product(matrix, x, out):
    """Fills out = matrix x, shapes (k, n), (n, N) and (k, N); out is not x."""
    for i in range(out.shape[0]):
        share = matrix[i, 0]
        for e in range(out.shape[1]):
            out[i, e] = share * x[0, e]
        for j in range(1, x.shape[0]):
            share = matrix[i, j]
            for e in range(out.shape[1]):
                out[i, e] += share * x[j, e]


@njit(cache=True, nogil=True, error_model="numpy")
def add_product(matrix, x, out):
    """Adds matrix x to out, shapes (k, n), (n, N) and (k, N); out is not x."""
    for i in range(out.shape[0]):
        for j in range(matrix.shape[1]):
            share = matrix[i, j]
            if share != 0.0:
                for e in range(out.shape[1]):
                    out[i, e] += share * x[j, e]
