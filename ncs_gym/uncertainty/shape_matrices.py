"""Shapes of ellipsoids as matrices: whether one ellipsoid lies inside another, and ellipsoids around two."""

from __future__ import annotations

import numpy as np

from ncs_gym import exact

# The multiplier of a term in an outer sum stays this far from 0 and 1, so that no division overflows.
SMALLEST_MULTIPLIER = 1e-9
# Relative rounding of a determinant of four entries, or per dimension of an eigenvalue, with room; products below the
# second number may have lost all their digits.
INCLUSION_ROUNDING, SMALLEST_PRODUCT = 64.0 * 2.0**-53, 1e-290
# Up to this dimension elimination in Python is faster than an eigenvalue call. A product of pivots above the second
# number leaves no doubt: with entries of at most 1 the smallest eigenvalue is then more than a third of it.
FEW, CLEARLY = 6, 1e-9


def is_inside(inner: np.ndarray, outer: np.ndarray) -> bool:
    """Returns whether E(inner) is shown to be a subset of E(outer): outer - inner >= 0 in exact arithmetic.

    What the rounding of this test could have decided counts as outside. Every entry of a difference is exact but for
    its own last digit, hence its sign, a zero and a diagonal difference are exact; a set lies inside itself.
    """
    difference = outer - inner
    if 2 < len(difference) <= FEW and _has_clear_pivots(difference.tolist(), outer.diagonal().tolist()):
        return True
    if difference.shape == (2, 2):  # four times faster than an eigenvalue call, and the common case
        a, b, d = difference.item(0), difference.item(1), difference.item(3)
        return a >= 0.0 and d >= 0.0 and (b == 0.0 or a * d * (1.0 - INCLUSION_ROUNDING) > b * b + SMALLEST_PRODUCT)
    diagonal = difference.diagonal()
    if not (diagonal >= 0.0).all():
        return False
    if np.count_nonzero(difference) == np.count_nonzero(diagonal):
        return True
    # In coordinates where the outer shape has unit diagonal: an eigenvalue's rounding then does not depend on units.
    extent = np.sqrt(outer.diagonal())
    moved = diagonal > 0.0
    if difference[~moved].any():
        return False
    # A direction in which nothing differs says nothing; in the others the smallest eigenvalue must exceed its rounding.
    extent = extent[moved]
    values = np.linalg.eigvalsh(difference[np.ix_(moved, moved)] / np.outer(extent, extent))
    return bool(values[0] > INCLUSION_ROUNDING * len(values) * values[-1])


def _has_clear_pivots(rows: list[list[float]], scales: list[float]) -> bool:
    """Returns whether rows, which are overwritten, of outer minus inner shape are clearly positive definite.

    In units of the outer shape, whose diagonal are the scales, no entry of the diagonal exceeds 1. The product of the
    pivots is the determinant, and by the means of the other eigenvalues the smallest one is at least
    det ((n-1)/n)^(n-1) > det / e; rounding moves it by less than n (n+1) 2^-53.
    """
    product = 1.0
    if not all(SMALLEST_PRODUCT < rows[k][k] <= scale for k, scale in enumerate(scales)):
        return False
    for k, pivot_row in enumerate(rows):
        pivot = pivot_row[k]
        if not pivot > 0.0:
            return False
        product *= pivot / scales[k]
        for row in rows[k + 1 :]:
            factor = row[k] / pivot
            for j in range(k + 1, len(rows)):
                row[j] -= factor * pivot_row[j]
    return product > CLEARLY


def outer_sum(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Returns P1/nu + P2/(1-nu), an ellipsoid around E(P1) + E(P2), with the smallest tr(W P), W positive definite.

    Source: docs/shield_proof.md, "Sums" (Cauchy-Schwarz on the supports); the best multiplier is
    nu = sqrt(tr W P1) / (sqrt(tr W P1) + sqrt(tr W P2)).
    """
    a = np.sqrt(max(exact.total(weight * first), 0.0))
    b = np.sqrt(max(exact.total(weight * second), 0.0))
    if not (a > 0.0 and b > 0.0) and not (first.any() and second.any()):
        return first + second
    share = a / (a + b) if a + b > 0.0 else 0.5  # traces may underflow
    nu = min(max(share, SMALLEST_MULTIPLIER), 1.0 - SMALLEST_MULTIPLIER)
    return first / nu + second / (1.0 - nu)


def joined(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the smallest ellipsoid around two: in axes in which both are diagonal, the larger of each entry.

    The first is positive definite, the second semidefinite.
    """
    root = np.linalg.cholesky(first)
    inverse = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse @ second @ inverse.T)
    turned = root @ axes
    shape = (turned * np.maximum(values, 1.0)) @ turned.T
    return 0.5 * (shape + shape.T)


def rounded_up(shape: np.ndarray, digits: int) -> np.ndarray:
    """Returns a slightly larger shape with so many digits relative to its extents, none of which is zero.

    What is added to the diagonal exceeds what rounding takes away.
    """
    extents = np.sqrt(np.diag(shape))
    unit = 10.0 ** (np.floor(np.log10(extents)) - digits // 2)
    extents = np.ceil(extents / unit) * unit
    ratios = np.round(shape / np.outer(extents, extents), digits) + len(shape) * 10.0**-digits * np.eye(len(shape))
    larger = ratios * np.outer(extents, extents)
    return 0.5 * (larger + larger.T)
