"""Bounds in plain terms: a radius, half-widths, an ellipsoid, or directions with the sizes of what acts along them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ncs_gym import exact
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import as_matrix, as_setting, shown

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    # What `as_bound` turns into an ellipsoid.
    Bound = ArrayLike | Ellipsoid | tuple[ArrayLike, ArrayLike]

# Sizes are squared, and must not become zero or infinite by that.
SMALLEST_SIZE, LARGEST_SIZE = 1e-37, 1e37


def as_bound(value: Any, size: int, name: str) -> Ellipsoid:
    """Returns the ellipsoid that a bound in plain terms stands for.

    | value | what is bounded | shape of the ellipsoid |
    |---|---|---|
    | r, a number | a ball, |z| <= r | r^2 I |
    | h, shape (size,) | a box, |z_i| <= h_i | q diag(h^2), the smallest around it, q the number of nonzero h_i |
    | an `Ellipsoid` | itself | its own |
    | (E, w), E of shape (size, q), w a number or shape (q,) | z = E s with |s_i| <= w_i | q E diag(w^2) E' |

    Args:
        value: One of these, in the units of z; zero is a bound too.
        size: Number of entries of z.
        name: What the error message calls it.

    Raises:
        ValueError: If it is none of these, negative, not finite, or of another size.
    """
    if isinstance(value, Ellipsoid):
        if value.dim != size:
            raise ValueError(f"{name} must be an ellipsoid of dimension {size}, got one of dimension {value.dim}")
        return value
    if _is_pair(value):
        E = as_matrix(value[0], (size, None), f"{name}: E of d = E w")
        return _around_box(E, _as_sizes(value[1], E.shape[1], f"{name}: w of d = E w"), name)
    sizes = as_setting(value)
    if sizes is None or sizes.ndim > 1:
        raise ValueError(
            f"{name} must be a number, half-widths of shape ({size},), an Ellipsoid(shape), or a pair (E, w) for "
            f"d = E w (a covariance has an argument of its own), got {shown(value)}"
        )
    widths = _as_sizes(value, size, name)
    return Ellipsoid(np.diag(np.square(widths))) if sizes.ndim == 0 else _around_box(np.eye(size), widths, name)


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


def _is_pair(value: Any) -> bool:
    """Returns whether a value is a pair (E, w): two entries, the first of which is a matrix."""
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        return False
    first = as_setting(value[0])
    return first is not None and first.ndim == 2


def _as_sizes(value: Any, size: int, name: str) -> np.ndarray:
    """Returns radii or half-widths, shape (size,)."""
    sizes = as_setting(value)
    if (
        sizes is None
        or sizes.shape not in ((), (size,))
        or not ((sizes == 0.0) | (sizes >= SMALLEST_SIZE) & (sizes <= LARGEST_SIZE)).all()
    ):
        allowed = f"0 or between {SMALLEST_SIZE:g} and {LARGEST_SIZE:g}"
        raise ValueError(f"{name} must be a number or shape ({size},), each {allowed}, got {shown(value)}")
    return np.broadcast_to(sizes, (size,))


def _around_box(E: np.ndarray, widths: np.ndarray, name: str) -> Ellipsoid:
    """Returns q E diag(w^2) E' around {E s : |s_i| <= w_i}, q the number of nonzero w_i."""
    scaled = E * widths
    if ((E != 0.0) & (widths != 0.0) & (np.abs(scaled) < SMALLEST_SIZE)).any():
        raise ValueError(f"{name}: the entries of E diag(w) must be 0 or at least {SMALLEST_SIZE:g} in size")
    return Ellipsoid(np.count_nonzero(widths) * exact.product(scaled, scaled.T))
