"""Ellipsoids by their shape, points of their sums, the test of a residual, and truncated Gaussian noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from flint import arb, ctx, fmpq

from ncs_gym import exact
from ncs_gym.validation import ReadOnlyArrays, as_covariance, read_only

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

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


# Directions whose variance is below this fraction of the largest count as flat: about 100 float64 roundings.
FLAT = 2e-14
# Points are not drawn along axes whose variance is below this fraction of the largest: that is room for rounding.
THIN = 1e-7
# A point this far off a flat ellipsoid, relative to its extent, still counts as rounding.
OFF_FLAT = 1e-12
# Newton's method for farthest points converges in about five steps, near the hard case in at most 25 of those tried; a
# step below this fraction of nu is rounding.
NEWTON_STEPS, NEWTON_PRECISION = 40, 1e-15
# A farthest point whose squared length lacks more than this is in the hard case.
HARD_CASE = 1e-9


class UncertainSet(ReadOnlyArrays, ABC):
    """A set of vectors z, shape (n,).

    Attributes:
        size: n; None while a number stands for as many entries as there are (`sized`).
        middle: Shape (n,): zero but for boxes with two different ends.
        is_left_out: Whether it bounds what a model leaves out of the process, inside the limits alone.
        kinds: The classes of sets, by their names in documents.
    """

    size: int | None = None
    middle: Any = 0.0
    is_left_out: ClassVar[bool] = False
    kinds: ClassVar[dict[str, type[UncertainSet]]] = {}
    __array_ufunc__ = None  # numpy would add a set to each entry of an array, and not to the box of half-widths

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Makes documents of sets know the class."""
        super().__init_subclass__(**keywords)
        UncertainSet.kinds[cls.__name__] = cls

    def sized(self, size: int) -> Any:
        """Returns the set of vectors with so many entries; raises ValueError if it has another number."""
        if self.size not in (None, size):
            raise ValueError(f"a set in dimension {size} is needed, got one in dimension {self.size}")
        return self

    @abstractmethod
    def ellipsoid(self, weight: np.ndarray | None = None) -> Ellipsoid:
        """Returns an ellipsoid around the set as seen from its middle; of sums that of the smallest tr(W P)."""

    def support(self, direction: np.ndarray) -> Any:
        """Returns max of a'z as seen from the middle, for a direction a (n,), or for each of shape (..., n)."""
        return self.ellipsoid().support(direction)

    def of_plant(self, plant: Any) -> Self:
        """Returns the set as a part of what this plant declares; raises ValueError if it belongs to another one."""
        return self

    @property
    def document(self) -> dict[str, Any]:
        """JSON values, every number exact, which `as_set` reads."""
        return {type(self).__name__: {each.name: document_of(getattr(self, each.name)) for each in fields(self)}}  # type: ignore[arg-type]

    def __add__(self, other: Any) -> Any:
        make: Any = UncertainSet.kinds["Sum"]
        return make((self, other))

    __radd__ = __add__


def document_of(value: Any) -> Any:
    """Returns a document, or a part of one, as JSON values in which infinity is the text "inf"."""
    if hasattr(value, "document"):
        return document_of(value.document)
    if isinstance(value, tuple | list):
        return [*map(document_of, value)]
    if isinstance(value, dict):
        return {name: document_of(each) for name, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return document_of(value.tolist())
    return str(value) if isinstance(value, float) and np.isinf(value) else value


def read_back(value: Any) -> Any:
    """Returns JSON values of `document_of` with their infinite numbers."""
    if isinstance(value, list):
        return [*map(read_back, value)]
    if isinstance(value, dict):
        return {name: read_back(each) for name, each in value.items()}
    return float(value) if isinstance(value, str) and value in ("inf", "-inf") else value


@dataclass(frozen=True, eq=False)
class Ellipsoid(UncertainSet):
    """The centered ellipsoid {z : a'z <= sqrt(a'Pa) for all a}: {z : z' P^-1 z <= 1}, flat where P is singular.

    Attributes:
        shape_matrix: P, shape (n, n) [square of the unit of z].

    Raises:
        ValueError: If it is not symmetric positive semidefinite.
    """

    shape_matrix: np.ndarray

    def __post_init__(self) -> None:
        shape = as_covariance(self.shape_matrix, None, "shape_matrix")
        self._set(shape_matrix=shape, size=len(shape))

    def ellipsoid(self, weight: np.ndarray | None = None) -> Ellipsoid:  # noqa: D102
        return self

    @property
    def dim(self) -> int:
        """The dimension n."""
        return self.shape_matrix.shape[0]

    @cached_property
    def factor(self) -> np.ndarray:
        """G with G G' = P, shape (n, n): the ellipsoid is the image of the unit ball under G."""
        scale, values, vectors = self._principal_axes
        return read_only(scale[:, None] * vectors * np.sqrt(values))

    @cached_property
    def _principal_axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Scales s of coordinates, and eigenvalues and eigenvectors of P_ij / (s_i s_j)."""
        scale = np.sqrt(np.maximum(np.diag(self.shape_matrix), 0.0))
        divisor = np.where(scale > 0.0, scale, 1.0)
        values, vectors = np.linalg.eigh(self.shape_matrix / np.outer(divisor, divisor))
        values = np.where(values > FLAT * max(values[-1], 0.0), values, 0.0)
        return scale, values, vectors

    @cached_property
    def drawn_axes(self) -> np.ndarray:
        """Which columns of the factor points are drawn along, shape (n,): those neither flat nor thin."""
        _, values, _ = self._principal_axes
        return (values > THIN * values[-1]) | (not values.any())

    def support(self, direction: np.ndarray) -> np.ndarray | float:
        """Returns max of a'z over the ellipsoid for a direction a (n,), or for each of shape (..., n)."""
        direction = np.asarray(direction, dtype=np.float64)
        value = np.sqrt(np.maximum(((direction @ self.shape_matrix) * direction).sum(axis=-1), 0.0))
        return float(value) if value.ndim == 0 else value

    def extreme_point(self, direction: np.ndarray) -> np.ndarray:
        """Returns a point, shape (n,), that attains the support in a direction."""
        image = self.shape_matrix @ direction
        height = np.sqrt(max(float(direction @ image), 0.0))
        return image / height if height > 0.0 else np.zeros(self.dim)

    def gauge(self, points: ArrayLike) -> Any:
        """Returns sqrt(z' P^-1 z) of a point, shape (n,), or of each of (count, n); infinite off a flat ellipsoid."""
        scale, values, vectors = self._principal_axes
        points = np.asarray(points, dtype=np.float64)
        coordinates = (points / np.where(scale > 0.0, scale, 1.0)) @ vectors
        flat = values == 0.0
        off = (np.abs(coordinates[..., flat]) > OFF_FLAT).any(axis=-1)
        off |= (points[..., scale == 0.0] != 0.0).any(axis=-1)
        gauges = np.where(off, np.inf, np.sqrt((coordinates[..., ~flat] ** 2 / values[~flat]).sum(axis=-1)))
        return float(gauges) if gauges.ndim == 0 else gauges

    def contains(self, point: np.ndarray) -> bool:
        """Returns whether a point, shape (n,), lies inside or on the boundary, without a tolerance."""
        return self.gauge(point) <= 1.0

    def sample(self, rng: np.random.Generator, count: int | None = None) -> np.ndarray:
        """Returns a uniform point, shape (n,), or `count` of them, (count, n)."""
        radius = rng.random(None if count is None else (count, 1)) ** (1.0 / np.count_nonzero(self.drawn_axes))
        return self.sample_boundary(rng, count) * radius

    def sample_boundary(self, rng: np.random.Generator, count: int | None = None) -> np.ndarray:
        """Returns boundary points, shape (n,) or (count, n): images of uniform directions of the drawn axes."""
        directions = rng.standard_normal(self.dim if count is None else (count, self.dim)) * self.drawn_axes
        return (directions / np.linalg.norm(directions, axis=-1, keepdims=True)) @ self.factor.T

    def farthest_point(self, centers: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Returns the z that maximize (center + z)' W (center + z), for centers of shape (n,) or (count, n).

        With z = G s and G'WG = V diag(values) V' it solves (nu I - G'WG) s = G'W center, |s| = 1, nu >= max(values):
        the trust-region problem with its sign turned. In the hard case the center does not pull along the longest axis,
        which takes what is missing to length 1.
        """
        values, vectors = np.linalg.eigh(self.factor.T @ weight @ self.factor)
        axes = self.factor @ vectors
        slopes = np.einsum("ij,kj->ik", axes.T @ weight, np.atleast_2d(centers))
        points = np.einsum("ij,jk->ki", axes, farthest_coordinates(slopes, values))
        return points[0] if np.ndim(centers) == 1 else points


def farthest_coordinates(slopes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns the s, |s| <= 1, that maximize s' diag(values) s + 2 slope's, for slopes (n, count), values ascending."""
    coordinates = slopes / (_trust_region_root(slopes, values) - values[:, None])
    squares = np.square(coordinates).sum(axis=0)
    coordinates = np.where(np.isfinite(squares), coordinates, 0.0)
    squares = np.where(np.isfinite(squares), squares, 0.0)
    last, missing = coordinates[-1], 1.0 - squares
    filled = np.copysign(np.sqrt(last * last + np.maximum(missing, 0.0)), last)
    coordinates[-1] = np.where(missing > HARD_CASE, filled, last)
    return coordinates / np.sqrt(np.maximum(squares, 1.0))


def _trust_region_root(slopes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns nu >= max(values) with sum_i (slope_i / (nu - value_i))^2 = 1 for each column of slopes, shape (count,).

    The norm as a function of nu is convex and falling, its inverse concave: Newton's method on 1/norm from the left of
    the root, where every term is at most 1, rises monotonically. A column that has converged moves no more.
    """
    values = values[:, None]
    length = np.sqrt(np.square(slopes).sum(axis=0))
    root = np.maximum((values + np.abs(slopes)).max(axis=0), values[0] + length)
    root = np.maximum(root, values[-1] + 1e-12 * np.maximum(values[-1], length))
    moving = np.ones(root.shape, np.bool_)
    for _ in range(NEWTON_STEPS):
        inverses = 1.0 / (root - values)
        parts = np.square(slopes * inverses)
        square = parts.sum(axis=0)
        step = square * (np.sqrt(square) - 1.0) / np.maximum((parts * inverses).sum(axis=0), 1e-300)
        step = np.where(moving & (square > 1.0), step, 0.0)
        root = root + step
        moving = step > NEWTON_PRECISION * root
        if not moving.any():
            break
    return root


def ellipsoid_around_sum(weight: np.ndarray, first: Ellipsoid, *others: Ellipsoid | None) -> Ellipsoid:
    """Returns an ellipsoid around the sum, one by one of the smallest tr(W P); points and None add nothing."""
    total = first
    for each in others:
        if each is not None and np.any(each.shape_matrix):
            shapes = total.shape_matrix, each.shape_matrix
            total = Ellipsoid(outer_sum(*shapes, weight)) if np.any(shapes[0]) else each
    return total


# A truncation that keeps less than this probability would make rejection sampling crawl.
SMALLEST_KEPT = 1e-3
# Smaller truncation levels are not offered: no datasheet knows them.
SMALLEST_DELTA = 1e-12
# Bits of ball arithmetic that tell nearly always on which side of a probability a tail lies.
PRECISION = 128


@dataclass(frozen=True, eq=False)
class TruncatedGaussian(ReadOnlyArrays):
    """w ~ N(0, covariance), shape (n, n), conditioned on w' covariance^-1 w <= energy.

    Attributes:
        covariance, energy: The same.
        known: How many of the last entries are known, and zero.
    """

    covariance: np.ndarray
    energy: float
    known: int = 0

    def __post_init__(self) -> None:
        self._make_arrays_read_only()

    @cached_property
    def bound(self) -> Ellipsoid:
        """The ellipsoid that holds every truncated sample."""
        return Ellipsoid(self.energy * self.covariance)

    @cached_property
    def factor(self) -> np.ndarray | None:
        """G with G G' = covariance, a column per unknown entry; None without noise, for which no number is drawn."""
        unknown = len(self.covariance) - self.known
        factor = Ellipsoid(self.covariance[:unknown, :unknown]).factor if np.any(self.covariance) else None
        return None if factor is None else np.pad(factor, ((0, self.known), (0, 0)))

    def sample(self, rng: np.random.Generator, count: int | None = None, *, truncated: bool = True) -> np.ndarray:
        """Returns one draw, shape (n,), or `count` of them, (count, n), of the truncated Gaussian or of itself."""
        size = 1 if count is None else count
        if self.factor is None:
            points = np.zeros((size, self.covariance.shape[0]))
        else:
            points = (self.factor @ self._normals(rng, size, self.energy if truncated else np.inf)).T
        return points[0] if count is None else points

    def _normals(self, rng: np.random.Generator, count: int, energy: float) -> np.ndarray:
        """Returns standard normal columns, shape (n, count), each with a sum of squares of at most `energy`."""
        normals = rng.standard_normal((len(self.covariance) - self.known, count))
        rejected = np.flatnonzero(~(np.square(normals).sum(axis=0) <= energy))
        while rejected.size:
            again = rng.standard_normal((len(normals), rejected.size))
            normals[:, rejected] = again
            rejected = rejected[~(np.square(again).sum(axis=0) <= energy)]
        return normals


@cache
def truncation_energy(delta: float, degrees: int) -> float:
    """Returns chi2_{degrees, 1 - delta}, rounded up: the smallest float64 exceeded with at most probability delta."""
    low, high = 0.0, 1.0
    while _cuts_off_more(high, delta, degrees):
        low, high = high, 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if _cuts_off_more(middle, delta, degrees) else (low, middle)
    return high


def _cuts_off_more(energy: float, delta: float, degrees: int) -> bool:
    precision = PRECISION
    while True:
        with ctx.workprec(precision):
            beyond = arb(energy / 2.0).gamma_upper(arb(fmpq(degrees, 2)), regularized=1)
            if beyond > arb(delta) or beyond <= arb(delta):
                return bool(beyond > arb(delta))
        precision *= 2


# Relative growth of every hard bound for the rounding of sampling and quantizing (docs/shield_proof.md), and of its
# diagonal, where it is flat.
INFLATION, FLAT_INFLATION = 1.0 + 1e-9, 1e-12
# An innovation this far beyond its exact bound counts as rounding, not as an alarm.
ALARM_TOLERANCE = 1e-9
# Up to this condition number, in the norm of Frobenius, an inverse says which residuals are possible to within 1e-3.
MAX_CONDITION_NUMBER = 1e7
# Halvings of the multiplier nu after which the point at which both parts are equally long is known to float64.
HALVINGS = 60


def inflated(shape: np.ndarray) -> np.ndarray:
    """Returns a slightly larger bound, with room for the rounding of its entries, also where it is flat."""
    return INFLATION * shape + FLAT_INFLATION * np.diag(np.diag(shape))


def quick_test(spread: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Returns W, shape (p, p), of the quick test, given H Sigma_k H' and N: a residual with r'Wr <= 1 is possible.

    The ellipsoid of shape H Sigma_k H' + N lies inside the Minkowski sum. Where its inverse would be too inexact, W is
    infinite on the diagonal: no residual passes then.
    """
    bound = spread + noise
    extent = np.sqrt(bound.diagonal())
    units = extent[:, None] * extent
    try:
        scaled = bound / units  # in units of its own
        inverse = np.linalg.inv(scaled)
        is_sure = np.vdot(scaled, scaled) * np.vdot(inverse, inverse) <= MAX_CONDITION_NUMBER**2  # NaN is not
    except np.linalg.LinAlgError:
        is_sure = False
    return inverse / units if is_sure else np.diag(np.full(len(bound), np.inf))


def outside_sum(points: np.ndarray, first: np.ndarray, second: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns which points, (k, p), lie outside E(P1) + E(P2), P2 > 0, by more than a relative tolerance, (k,).

    While the assumptions hold, a residual y - H x_hat lies in E(H Sigma_k H') + E(N).
    """
    axes, values = common_axes(first, second)
    return outside_sum_in_axes(np.square(axes @ points.T), values[:, None], tolerance)


def outside_sum_in_axes(squares: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns which points lie outside E(P1) + E(P2), in axes in which both are diagonal, bool of shape (k,).

    Any multiplier nu splits r into P1 w / nu + P2 w / (1-nu) with w = (P1/nu + P2/(1-nu))^-1 r. If both parts lie in
    their ellipsoids, r lies in the sum; if r'w > 1, it does not. r'w is concave in nu, and its slope is the difference
    of the parts' squared gauges, so that halving finds a multiplier that decides.

    Args:
        squares: Squared coordinates of the points in the axes F of `common_axes`, shape (p, k); NaN lies outside.
        values: Diagonals of F P1 F' where F P2 F' = I, shape (p, k) or (p, 1).
        tolerance: Relative.
    """
    count, limit = squares.shape[1], (1.0 + tolerance) ** 2
    values = np.broadcast_to(values, squares.shape)
    outside, undecided = np.ones(count, np.bool_), np.arange(count)
    low, high = np.zeros(count), np.ones(count)
    for _ in range(HALVINGS):
        nu = 0.5 * (low + high)
        weights = nu * (1.0 - nu) / (values * (1.0 - nu) + nu)
        form = (squares * weights).sum(axis=0)
        in_first = (squares * values * (weights / nu) ** 2).sum(axis=0)
        in_second = (squares * (weights / (1.0 - nu)) ** 2).sum(axis=0)
        outside[undecided] = ~(form <= limit)
        rest = (form <= limit) & (np.maximum(in_first, in_second) > limit)
        if not rest.any():
            break
        rises = in_first > in_second
        low, high = np.where(rises, nu, low)[rest], np.where(rises, high, nu)[rest]
        undecided, squares, values = undecided[rest], squares[:, rest], values[:, rest]
    return outside


def common_axes(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns F, shape (p, p), and j >= 0, shape (p,), with F P1 F' = diag(j) and F P2 F' = I.

    Where P2 is flat in float64 it is a little larger: what is then still outside of the sum is outside.
    """
    try:
        root = np.linalg.cholesky(second)
    except np.linalg.LinAlgError:
        root = np.linalg.cholesky(second + FLAT_INFLATION * np.diag(np.diag(first + second)))
    inverse = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse @ (0.5 * (first + first.T)) @ inverse.T)
    return axes.T @ inverse, np.maximum(values, 0.0)
