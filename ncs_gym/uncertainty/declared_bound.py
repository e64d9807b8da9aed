"""Bounds in plain terms: a radius, half-widths, an ellipsoid, or directions with the sizes of what acts along them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ncs_gym.bounds import Ball, Through, as_set, require_about_zero
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import as_setting

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    # What `as_bound` turns into an ellipsoid.
    Bound = ArrayLike | Ellipsoid | tuple[ArrayLike, ArrayLike]


def as_bound(value: Any, size: int, name: str) -> Ellipsoid:
    """Returns the ellipsoid around `declared_set`; raises ValueError unless its middle is zero."""
    own = declared_set(value, size, name)
    require_about_zero(own, name)
    return own.ellipsoid()


def declared_set(value: Any, size: int, name: str) -> Any:
    """Returns the set of `ncs_gym.bounds` that an argument of `LinearPlant` stands for, of vectors z of this size.

    A number r is a ball |z| <= r, a vector of shape (size,) half-widths of a box, an `Ellipsoid` itself, and a pair
    (E, w), E of shape (size, q), w a number or shape (q,), stands for z = E s with |s_i| <= w_i.

    Raises:
        ValueError: If it is none of these, negative, not finite, or of another size.
    """
    try:
        pair = tuple(value) if isinstance(value, tuple | list) and len(value) == 2 else ()
        if pair and (E := as_setting(pair[0])) is not None and E.ndim == 2:
            return Through(*pair).sized(size)
        number: Any = as_setting(value)
        return (as_set(value) if number is None or number.ndim else Ball(number)).sized(size)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def sample_box(bound: Ellipsoid, rng: np.random.Generator, count: int | None = None) -> np.ndarray:
    """Returns points that are uniform in the box inside an ellipsoid along its principal axes.

    For a bound given by half-widths that is the box of these half-widths.

    Args:
        bound: The ellipsoid.
        rng: Source of randomness.
        count: Number of points; None for a single one.

    Returns:
        Shape (n,), or (n, count).
    """
    axes = bound.factor * bound.drawn_axes / np.sqrt(np.count_nonzero(bound.drawn_axes))
    return axes @ rng.uniform(-1.0, 1.0, bound.dim if count is None else (bound.dim, count))


def diagonal_inside(bound: Ellipsoid) -> np.ndarray:
    """Returns the diagonal shape of an ellipsoid inside one, shape (n, n): that itself if its axes are the coordinates.

    It is j diag(P), j the smallest eigenvalue of P in units in which its diagonal is 1.
    """
    variances = np.diag(bound.shape_matrix)
    kept = variances > 0.0
    if not kept.any() or np.array_equal(bound.shape_matrix, np.diag(variances)):
        return bound.shape_matrix
    scale = np.sqrt(variances[kept])
    smallest = np.linalg.eigvalsh(bound.shape_matrix[np.ix_(kept, kept)] / np.outer(scale, scale))[0]
    return max(float(smallest), 0.0) * np.diag(variances)
