"""Ellipsoids given by their shape, and sums of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from ncs_gym.validation import FrozenArrays, as_covariance, read_only

# Directions whose variance is below this share of the largest count as flat: about 100 float64 roundings.
FLAT = 2e-14
# A point this far off a flat ellipsoid, relative to its extent, still counts as rounding.
OFF_FLAT = 1e-12
# The share of a term in an outer sum stays this far from 0 and 1, so that no division overflows.
SMALLEST_SHARE = 1e-9


@dataclass(frozen=True, eq=False)
class Ellipsoid(FrozenArrays):
    """The centered ellipsoid {z : a'z <= sqrt(a'Pa) for all a} with shape P.

    For an invertible shape this is {z : z' P^-1 z <= 1}; a singular shape is a flat ellipsoid
    (zero: the origin alone).

    Attributes:
        shape: P, shape (n, n), symmetric positive semidefinite [square of the unit of z].

    Raises:
        ValueError: If the shape is not a finite, symmetric, positive semidefinite square matrix.
    """

    shape: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", as_covariance(self.shape, None, "shape"))
        self._freeze_arrays()

    @property
    def dim(self) -> int:
        """The dimension n."""
        return self.shape.shape[0]

    @cached_property
    def factor(self) -> np.ndarray:
        """G with G G' = P, shape (n, n): the ellipsoid is the image of the unit ball under G."""
        scale, values, vectors = self._principal_axes
        return read_only(scale[:, None] * vectors * np.sqrt(values))

    @cached_property
    def _principal_axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinate scales s, and eigenvalues and eigenvectors of P_ij / (s_i s_j)."""
        scale = np.sqrt(np.maximum(np.diag(self.shape), 0.0))
        divisor = np.where(scale > 0.0, scale, 1.0)
        values, vectors = np.linalg.eigh(self.shape / np.outer(divisor, divisor))
        values = np.where(values > FLAT * max(values[-1], 0.0), values, 0.0)
        return scale, values, vectors

    def support(self, direction: np.ndarray) -> np.ndarray | float:
        """Returns max of a'z over the ellipsoid for a direction a (n,), or for each row of (k, n)."""
        direction = np.asarray(direction, dtype=np.float64)
        value = np.sqrt(np.maximum(((direction @ self.shape) * direction).sum(axis=-1), 0.0))
        return float(value) if value.ndim == 0 else value

    def extreme_point(self, direction: np.ndarray) -> np.ndarray:
        """Returns a point of the ellipsoid, shape (n,), that attains the support in `direction`."""
        image = self.shape @ direction
        height = np.sqrt(max(float(direction @ image), 0.0))
        return image / height if height > 0.0 else np.zeros(self.dim)

    def gauge(self, point: np.ndarray) -> float:
        """Returns sqrt(z' P^-1 z): 0 at the center, 1 on the boundary, inf off a flat ellipsoid."""
        scale, values, vectors = self._principal_axes
        point = np.asarray(point, dtype=np.float64)
        if np.any(point[scale == 0.0] != 0.0):
            return float("inf")
        coordinates = vectors.T @ (point / np.where(scale > 0.0, scale, 1.0))
        flat = values == 0.0
        if np.any(np.abs(coordinates[flat]) > OFF_FLAT):
            return float("inf")
        return float(np.sqrt((coordinates[~flat] ** 2 / values[~flat]).sum()))

    def gauges(self, points: np.ndarray) -> np.ndarray:
        """Returns the gauge of each row of points (count, n), shape (count,)."""
        scale, values, vectors = self._principal_axes
        coordinates = (points / np.where(scale > 0.0, scale, 1.0)) @ vectors
        flat = values == 0.0
        off = (np.abs(coordinates[:, flat]) > OFF_FLAT).any(axis=1) | (points[:, scale == 0.0] != 0.0).any(axis=1)
        return np.where(off, np.inf, np.sqrt((coordinates[:, ~flat] ** 2 / values[~flat]).sum(axis=1)))

    def contains(self, point: np.ndarray) -> bool:
        """Returns whether a point, shape (n,), lies inside or on the boundary (in float64, no tolerance)."""
        return self.gauge(point) <= 1.0

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Returns a uniformly distributed point, shape (n,)."""
        return self.sample_boundary(rng) * rng.random() ** (1.0 / self.dim)

    def sample_many(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Returns uniformly distributed points, shape (count, n)."""
        return self.sample_boundary_many(rng, count) * rng.random((count, 1)) ** (1.0 / self.dim)

    def sample_boundary_many(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Returns boundary points as `sample_boundary` does, shape (count, n)."""
        directions = rng.standard_normal((count, self.dim))
        return (directions / np.linalg.norm(directions, axis=1, keepdims=True)) @ self.factor.T

    def sample_boundary(self, rng: np.random.Generator) -> np.ndarray:
        """Returns a boundary point, shape (n,): the image of a uniform direction of the unit sphere."""
        direction = rng.standard_normal(self.dim)
        return self.factor @ (direction / np.linalg.norm(direction))

    def outer_sum(self, other: Ellipsoid) -> Ellipsoid:
        """Returns the trace-smallest ellipsoid of the family P1/nu + P2/(1-nu) around the Minkowski sum."""
        return Ellipsoid(outer_sum(self.shape, other.shape, np.eye(self.dim)))

    def sum_contains(self, other: Ellipsoid, point: np.ndarray) -> bool:
        """Returns whether a point lies in the Minkowski sum of both ellipsoids (see `sum_gauge`)."""
        return sum_gauge(point, self.shape, other.shape) <= 1.0

    def farthest_points(self, centers: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Returns what `farthest_point` does for each row of centers (count, n), shape (count, n)."""
        from ncs_gym.roots import fill_farthest  # the compiler takes half a second to import

        factor = self.factor
        values, vectors = np.linalg.eigh(factor.T @ weight @ factor)
        outward, points = factor @ vectors, np.empty(centers.shape)
        inward = np.ascontiguousarray(outward.T @ weight)
        fill_farthest(np.ascontiguousarray(centers), inward, values, np.ascontiguousarray(outward), points)
        return points

    def farthest_point(self, center: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Returns z of the ellipsoid that maximizes (center + z)' W (center + z).

        Args:
            center: Shape (n,).
            weight: W, shape (n, n), symmetric positive semidefinite.

        Returns:
            The maximizer, shape (n,): with z = G s it solves (nu I - G'WG) s = G'W center, |s| = 1,
            nu >= lambda_max (the trust-region problem with its sign turned).
        """
        factor = self.factor
        values, vectors = np.linalg.eigh(factor.T @ weight @ factor)
        slope = vectors.T @ (factor.T @ (weight @ center))
        length = float(np.linalg.norm(slope))
        top = float(values[-1])
        coordinates = np.zeros(self.dim)
        if length > 0.0:
            lowest = top + 1e-12 * max(top, length)

            def excess(multiplier: float) -> float:
                return 1.0 - 1.0 / float(np.linalg.norm(slope / (multiplier - values)))

            if excess(lowest) > 0.0:
                multiplier = brentq(excess, lowest, top + 2.0 * length, xtol=1e-14 * (top + length))
            else:  # the "hard case": no pull along the longest axis
                multiplier = lowest
            coordinates = slope / (multiplier - values)
        missing = max(1.0 - float(coordinates @ coordinates), 0.0)
        coordinates[-1] += np.copysign(np.sqrt(missing), coordinates[-1]) if missing > 1e-9 else 0.0
        return factor @ (vectors @ (coordinates / max(1.0, float(np.linalg.norm(coordinates)))))


def is_inside(inner: np.ndarray, outer: np.ndarray) -> bool:
    """Returns whether E(inner) is a subset of E(outer): outer - inner >= 0, without any tolerance."""
    difference = outer - inner
    if difference.shape == (2, 2):  # four times faster than an eigenvalue call, and the common case
        a, b, d = difference.item(0), difference.item(1), difference.item(3)
        return a >= 0.0 and d >= 0.0 and a * d - b * b >= 0.0
    # In coordinates where the outer shape has unit diagonal: an eigenvalue's rounding then does not depend on units.
    extent = np.sqrt(np.maximum(np.diag(outer), 0.0))
    extent[extent == 0.0] = 1.0
    return bool(np.linalg.eigvalsh(difference / np.outer(extent, extent))[0] >= 0.0)


def outer_sum(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Returns P1/nu + P2/(1-nu), an ellipsoid around E(P1) + E(P2), with the smallest tr(W P).

    Source: theory.md section 1 (Cauchy-Schwarz on the supports); the best share is
    nu = sqrt(tr W P1) / (sqrt(tr W P1) + sqrt(tr W P2)).

    Args:
        first: P1, shape (n, n).
        second: P2, shape (n, n).
        weight: W, shape (n, n), positive definite, so that a zero trace means a zero shape.
    """
    a = np.sqrt(max(float(np.vdot(weight, first)), 0.0))
    b = np.sqrt(max(float(np.vdot(weight, second)), 0.0))
    if b == 0.0:
        return first + second
    share = min(max(a / (a + b), SMALLEST_SHARE), 1.0 - SMALLEST_SHARE)
    return first / share + second / (1.0 - share)


def joined(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the smallest ellipsoid around two: in axes in which both are diagonal, the larger of each entry.

    Args:
        first: P1, shape (n, n), positive definite.
        second: P2, shape (n, n), positive semidefinite.
    """
    root = np.linalg.cholesky(first)
    inverse = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse @ second @ inverse.T)
    turned = root @ axes
    shape = (turned * np.maximum(values, 1.0)) @ turned.T
    return 0.5 * (shape + shape.T)


def sum_gauge(point: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Returns sqrt(max over nu of r'(P1/nu + P2/(1-nu))^-1 r): at most 1 exactly if r is in E(P1) + E(P2).

    The intersection of all E(P1/nu + P2/(1-nu)) is the Minkowski sum, and the form is concave in nu
    (theory.md section 1). A result above 1 proves that the point lies outside.

    Args:
        point: r, shape (n,).
        first: P1, shape (n, n), positive semidefinite.
        second: P2, shape (n, n), positive semidefinite.
    """

    def gauge(share: float) -> float:
        shape = first / share + second / (1.0 - share)
        return Ellipsoid(0.5 * (shape + shape.T)).gauge(point)

    # In units in which neither overflows: the gauge does not change.
    size = float(max(np.abs(np.diag(first)).max(), np.abs(np.diag(second)).max()))
    if 0.0 < size < np.inf:
        point, first, second = point / size**0.5, first / size, second / size
    if not np.any(second):
        return Ellipsoid(first).gauge(point)
    if not np.any(first):
        return Ellipsoid(second).gauge(point)
    best = minimize_scalar(
        lambda share: -gauge(share),
        bounds=(SMALLEST_SHARE, 1.0 - SMALLEST_SHARE),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return max(-float(best.fun), gauge(0.5))
