"""Numbers that come out the same on every machine: computed in rational or ball arithmetic, then rounded once.

BLAS, LAPACK and SIMD round differently on different processors. What identifies a plant, and every number that a proof
takes from it, is made by these functions, or by single operations of float64 (+, -, *, /, sqrt), which IEEE 754
prescribes to the last bit. FLINT computes (https://flintlib.org).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

# Bits of ball arithmetic to begin with, and at most: a ball that is still ambiguous there holds a tie of two floats.
FIRST_PRECISION, LAST_PRECISION = 128, 4096
# Beyond these powers of two the nearest float64 is zero, or there is none.
SMALLEST, LARGEST = arb(2) ** -1080, arb(2) ** 1025


def product(*factors: np.ndarray) -> np.ndarray:
    """Returns the product of float matrices, the last of which may be a vector, every entry rounded once."""
    if not len(factors[0]):
        return np.zeros((0, *factors[-1].shape[1:]))
    columns = [*factors[:-1], factors[-1].reshape(len(factors[-1]), -1)]
    exact = reduce(lambda left, right: left * right, map(_rational, columns))
    return _rounded(exact).reshape((len(factors[0]), *factors[-1].shape[1:]))


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Returns the inverse of a float matrix, every entry rounded once; raises ZeroDivisionError if it is singular."""
    return _rounded(_rational(matrix).inv())


def pseudoinverse(rows: np.ndarray) -> np.ndarray:
    """Returns (C'C)^-1 C' of a float matrix C, shape (n, k), every entry rounded once.

    Raises:
        ZeroDivisionError: If its columns are not independent.
    """
    if not rows.size:
        return np.zeros(rows.T.shape)
    exact = _rational(rows)
    return _rounded((exact.transpose() * exact).inv() * exact.transpose())


def rank(matrix: np.ndarray) -> int:
    """Returns the rank of a float matrix."""
    return int(_rational(matrix).rank())


def total(values: np.ndarray) -> float:
    """Returns the sum of all entries, rounded once."""
    return math.fsum(values.ravel().tolist())


def rounded(numbers: np.ndarray | float, digits: int, axis: int | None = None) -> np.ndarray:
    """Returns finite numbers, rounded to so many decimal digits of the largest one, or of that along an axis.

    What BLAS computed, and differs between machines in its last bits, is nearly always the same after that.
    """
    array = np.asarray(numbers, dtype=np.float64)
    largest = np.broadcast_to(np.abs(array).max(axis=axis, keepdims=axis is not None, initial=0.0), array.shape)
    places = [digits - 1 - _exponent(size) for size in largest.ravel().tolist()]
    entries = zip(array.ravel().tolist(), places, strict=True)
    return np.array([round(entry, place) + 0.0 for entry, place in entries]).reshape(array.shape)


def _exponent(size: float) -> int:
    return int(f"{size:e}".partition("e")[2])


def exponential(generator: np.ndarray, time: float) -> np.ndarray:
    """Returns exp(G t) of a float matrix G, shape (n, n), every entry rounded once."""
    exact = _rational(generator) * _as_rational(time)
    return np.reshape(nearest(lambda: arb_mat(exact).exp().entries()), generator.shape)


def nearest(balls: Callable[[], list[Any]]) -> list[float]:
    """Returns the float64 numbers next to real numbers, given enclosures at the precision of FLINT's context.

    Raises:
        OverflowError: If no precision encloses them, or one is too large for a float64.
    """
    precision = FIRST_PRECISION
    while True:
        with ctx.workprec(precision):
            numbers = balls()
            if all(number.is_finite() for number in numbers):
                ends = [[_nearest_to_end(end(number)) for number in numbers] for end in (arb.lower, arb.upper)]
                if ends[0] == ends[1]:
                    return ends[0]
                if precision >= LAST_PRECISION:
                    return [_tie(low, high) for low, high in zip(*ends, strict=True)]
        if precision >= LAST_PRECISION:
            raise OverflowError("a number cannot be enclosed closely enough")
        precision *= 2


def _nearest_to_end(end: Any) -> float:
    """Returns the float64 next to the end of a ball, which as a rational number might fill the memory."""
    if abs(end) < SMALLEST:
        return 0.0
    if abs(end) > LARGEST:
        raise OverflowError("a number is too large for a float64")
    return _nearest_to(end.fmpq())


def _tie(low: float, high: float) -> float:
    """Returns the even one of two floats whose midpoint is, as far as any precision tells, the number itself."""
    if low != high and math.nextafter(low, math.inf) != high:
        raise OverflowError("a number cannot be enclosed closely enough")
    return _nearest_to((_as_rational(low) + _as_rational(high)) / 2)


def _rational(matrix: np.ndarray) -> Any:
    return fmpq_mat([[_as_rational(entry) for entry in row] for row in matrix.tolist()])


def _as_rational(number: float) -> Any:
    return fmpq(*float(number).as_integer_ratio())


def _rounded(matrix: Any) -> np.ndarray:
    return np.array([[_nearest_to(entry) for entry in row] for row in matrix.tolist()])


def _nearest_to(number: Any) -> float:
    """Returns the float64 next to a rational number: Python divides whole numbers with a single rounding."""
    return int(number.p) / int(number.q) + 0.0  # a zero has no sign
