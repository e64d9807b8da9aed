"""What is uncertain about a plant: sets, all of which answer the same questions, and the three of them that bound it.

A number or a vector stands for half-widths per entry. Ellipsoids around sets are the same on every machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ncs_gym import exact
from ncs_gym.ellipsoid import (
    SMALLEST_DELTA,
    SMALLEST_KEPT,
    Ellipsoid,
    UncertainSet,
    ellipsoid_around_sum,
    truncation_energy,
)
from ncs_gym.validation import ReadOnlyArrays, as_covariance, as_matrix, as_number, as_setting, shown

# Sizes are squared, and must not become zero or infinite by that.
SMALLEST_SIZE, LARGEST_SIZE = 1e-37, 1e37
# Probability that Gaussian noise of the library is truncated at, and that of what is zero.
DELTA = 0.05
_NAMES = "disturbance", "sensor", "first_error"


@dataclass(frozen=True, eq=False)
class Box(UncertainSet):
    """{z : low <= z <= high}, with ends of shape (n,), or numbers for every entry.

    Raises:
        ValueError: If they are no such ends, or low > high anywhere.
    """

    low: Any
    high: Any

    def __post_init__(self) -> None:
        given: Any = self.low, self.high
        ends: list[Any] = [*map(as_setting, given)]
        fits = all(e is not None and e.ndim <= 1 and e.size and (np.abs(e) <= LARGEST_SIZE).all() for e in ends)
        fits = fits and len({*map(np.shape, ends)} - {()}) <= 1
        low, high = np.array(np.broadcast_arrays(*ends)) if fits else np.array([1.0, 0.0])
        self._set(low=low, high=high, middle=0.5 * (high + low), size=low.size if low.ndim else None)
        if not ((self.half == 0.0) | (self.half >= SMALLEST_SIZE)).all():
            form = f"low <= high of one size, within {LARGEST_SIZE:g} of 0, half-widths 0 or at least {SMALLEST_SIZE:g}"
            raise ValueError(f"a box needs two ends, {form}, got {shown(given)}")

    @cached_property
    def half(self) -> np.ndarray:
        """Half-widths, shape (n,), or a number, by the farther end from the rounded middle."""
        return np.maximum(self.high - self.middle, self.middle - self.low)

    def sized(self, size: int) -> Any:  # noqa: D102
        if self.size is not None:
            return super().sized(size)
        return Box(np.full(size, self.low), np.full(size, self.high))

    def ellipsoid(self, weight: np.ndarray | None = None) -> Ellipsoid:  # noqa: D102
        return Ellipsoid(np.count_nonzero(self.half) * np.diag(np.atleast_1d(np.square(self.half))))

    def support(self, direction: np.ndarray) -> Any:  # noqa: D102
        return np.abs(direction) @ np.atleast_1d(self.half)


@dataclass(frozen=True, eq=False)
class Ball(UncertainSet):
    """{z : |z| <= radius}, of as many entries as there are."""

    radius: float

    def __post_init__(self) -> None:
        self._set(radius=as_number(self.radius, "the radius of a ball", low=0.0))
        Box(-self.radius, self.radius)

    def sized(self, size: int) -> Any:  # noqa: D102
        return Ellipsoid(np.square(self.radius) * np.eye(size))

    def ellipsoid(self, weight: np.ndarray | None = None) -> Ellipsoid:  # noqa: D102
        return self.sized(1)


@dataclass(frozen=True, eq=False)
class Gaussian(UncertainSet):
    """N(0, covariance), truncated so that its bound holds the fraction 1 - delta of it, delta in [1e-12, 0.999]."""

    covariance: Any
    delta: float

    def __post_init__(self) -> None:
        covariance = as_covariance(self.covariance, None, "the covariance of a Gaussian")
        delta = as_number(self.delta, "delta", low=SMALLEST_DELTA, high=1.0 - SMALLEST_KEPT)
        self._set(covariance=covariance, delta=delta, size=len(covariance))

    def ellipsoid(self, weight: np.ndarray | None = None) -> Ellipsoid:  # noqa: D102
        return Ellipsoid(truncation_energy(self.delta, len(self.covariance)) * self.covariance)


@dataclass(frozen=True, eq=False)
class Through(UncertainSet):
    """{E w : w in a box}, E of shape (n, q): half-widths or a `Box`; another's shape or covariance is E P E'."""

    E: Any
    set: Any

    def __post_init__(self) -> None:
        E = as_matrix(self.E, (None, None), "E of a set through E")
        own = as_set(self.set).sized(E.shape[1])
        if not isinstance(own, Box):
            raise ValueError(f"Through takes half-widths or a Box; give others as E P E', got {shown(self.set)}")
        scaled = E * own.half
        if ((E != 0.0) & (own.half != 0.0) & (np.abs(scaled) < SMALLEST_SIZE)).any():
            raise ValueError(f"the entries of E diag(half-widths) must be 0 or at least {SMALLEST_SIZE:g} in size")
        self._set(E=E, set=own, size=len(E), middle=exact.product(E, own.middle))

    def ellipsoid(self, weight: np.ndarray | None = None) -> Ellipsoid:
        """Returns the smallest one around, q E diag(h^2) E' with q the number of half-widths h > 0."""
        scaled = self.E * self.set.half
        return Ellipsoid(np.count_nonzero(self.set.half) * exact.product(scaled, scaled.T))

    def support(self, direction: np.ndarray) -> Any:  # noqa: D102
        return self.set.support(direction @ self.E)


@dataclass(frozen=True, eq=False)
class Sum(UncertainSet):
    """All sums of one vector from each of several sets, of which one may be a Gaussian; `a + b` makes one."""

    parts: tuple[Any, ...]

    def __post_init__(self) -> None:
        given = [as_set(each) for each in self.parts]
        parts = [part for each in given for part in (each.parts if isinstance(each, Sum) else [each])]
        if sum(isinstance(each, Gaussian) for each in parts) > 1:
            raise ValueError("a sum may have one Gaussian: add the covariances")
        self._set(parts=tuple(parts), size=next((each.size for each in parts if each.size), None))
        self._set(middle=sum(each.middle for each in self.sized(self.size or 1).parts))

    @property
    def gaussian(self) -> Any:
        """The part that is a Gaussian; None if there is none."""
        return next((each for each in self.parts if isinstance(each, Gaussian)), None)

    @property
    def declared(self) -> Sum:
        """The sum of all but what a model leaves out."""
        return Sum(tuple(each for each in self.parts if not each.is_left_out))

    def sized(self, size: int) -> Any:  # noqa: D102
        sized = tuple(each.sized(size) for each in self.parts)
        return self if sized == self.parts else Sum(sized)

    def ellipsoid(self, weight: np.ndarray | None = None) -> Ellipsoid:  # noqa: D102
        if not self.parts:
            raise ValueError("a sum of no sets has no dimension: give 0")
        around = [each.ellipsoid(weight) for each in self.parts]
        return ellipsoid_around_sum(np.eye(around[0].dim) if weight is None else weight, *around)

    def support(self, direction: np.ndarray) -> Any:  # noqa: D102
        return sum(each.support(direction) for each in self.parts)


def pushes_of(own: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns all E, shape (n, q), and w, shape (q,), whose E w add up to the middle of a set; none is zero."""
    if isinstance(own, Sum):
        return [each for part in own.parts for each in pushes_of(part)]
    E, w = (own.E, own.set.middle) if isinstance(own, Through) else (np.eye(own.size), own.middle)
    return [(E, w)] if np.any(w) else []


def as_set(value: Any) -> Any:
    """Returns a set, that of a document, or the box of half-widths, a number or shape (n,); or raises ValueError."""
    if isinstance(value, UncertainSet):
        return value
    name, content = next(iter(value.items()), ("", 0)) if isinstance(value, Mapping) and len(value) == 1 else ("", 0)
    kinds: dict[str, Any] = UncertainSet.kinds
    if name in kinds and isinstance(content, Mapping):
        with suppress(TypeError):  # other entries than the set's
            return kinds[name](**content)
    half = as_setting(value)
    if half is None or half.ndim > 1 or not (half >= 0.0).all():
        raise ValueError(f"a set must be a number >= 0, half-widths or one of {', '.join(kinds)}, got {shown(value)}")
    return Box(-half, half)


@dataclass(frozen=True, eq=False)
class Bounds(ReadOnlyArrays):
    """What bounds the uncertainties of a plant: sets, or half-widths, numbers or vectors; 0 says that there is none.

    Attributes:
        disturbance: Of d in x+ = A x + B u + d; its middle moves the point that deviations are counted from.
        sensor: Of v in y = H x + v, about zero.
        first_error: Of the error of the first estimate, about zero.

    Raises:
        ValueError: If one is no set, or one about zero is not.
    """

    disturbance: Any
    sensor: Any
    first_error: Any

    def __post_init__(self) -> None:
        for name in _NAMES:
            try:
                own = as_set(getattr(self, name))
            except ValueError as error:
                raise ValueError(f"Bounds({name}=...): {error}") from error
            self._set(**{name: own})
            middle = np.array(own.middle)
            if name != "disturbance" and middle.any():
                raise ValueError(f"Bounds({name}=...) must have its middle at zero, got {shown(middle.tolist())}")

    def sums(self, n: int, p: int) -> list[Sum]:
        """Returns the three as sums of sets of a plant with n states and p outputs, or raises ValueError."""
        sums = [Sum((getattr(self, name),)) for name in _NAMES]
        left_out = [sum(part.is_left_out for part in each.parts) for each in sums]
        if left_out[0] > 1 or any(left_out[1:]):
            raise ValueError("Bounds of disturbances may have one remainder, and others none")
        if len(deltas := {each.gaussian.delta for each in sums if each.gaussian}) > 1:
            raise ValueError(f"all Gaussians of a plant must have the same delta, got {shown(sorted(deltas))}")
        for name, each, size in zip(_NAMES, sums, (n, p, n), strict=True):
            if each.size not in (None, size):
                needed = f"a set in dimension {size} is needed, got one in dimension {each.size}"
                raise ValueError(f"Bounds({name}=...): {needed}")
        return sums
