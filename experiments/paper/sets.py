"""The sets that the paper bounds disturbances and errors by: farthest points, and exact membership."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from shields.verification.rational_matrix import Matrix, rational, scale


@dataclass(frozen=True)
class Ball:
    """{z : z'z <= squared_radius}, the set Delta(squared_radius) of (3)."""

    squared_radius: float

    def extreme_point(self, slope: np.ndarray) -> np.ndarray:
        """Returns the point farthest along a slope, shape (n,)."""
        length = np.linalg.norm(slope)
        return self.squared_radius**0.5 * slope / length if length > 0.0 else np.zeros_like(slope)

    def contains(self, point: np.ndarray) -> bool:
        """Returns whether a point, shape (n,), lies inside, in exact arithmetic."""
        return _squared(point) <= Fraction(self.squared_radius)

    def exact_shape(self, n: int) -> Matrix:
        """Returns P with {z : a'z <= sqrt(a'Pa) for all a} the set, as rational numbers."""
        return scale(Fraction(self.squared_radius), rational(np.eye(n)))


@dataclass(frozen=True, eq=False)
class Segment:
    """{t vector : t^2 vector'vector <= squared_radius}, for a vector of shape (n,)."""

    vector: np.ndarray
    squared_radius: float

    def extreme_point(self, slope: np.ndarray) -> np.ndarray:
        """Returns the point farthest along a slope, shape (n,)."""
        end = (self.squared_radius / (self.vector @ self.vector)) ** 0.5 * self.vector
        return end if end @ slope >= 0.0 else -end

    def contains(self, point: np.ndarray) -> bool:
        """Returns whether a point, shape (n,), lies within the ends of the segment, in exact arithmetic.

        The rounding of a point next to the line is not looked at.
        """
        return _squared(point) <= Fraction(self.squared_radius)

    def exact_shape(self, n: int) -> Matrix:
        """Returns P with {z : a'z <= sqrt(a'Pa) for all a} the set, as rational numbers."""
        factor = Fraction(self.squared_radius) / _squared(self.vector)
        entries = [Fraction(float(entry)) for entry in self.vector]
        return [[factor * left * right for right in entries] for left in entries]


@dataclass(frozen=True, eq=False)
class Box:
    """{z : |z_i| <= half_widths_i}, for half-widths of shape (n,)."""

    half_widths: np.ndarray

    def extreme_point(self, slope: np.ndarray) -> np.ndarray:
        """Returns the point farthest along a slope, shape (n,)."""
        return np.where(slope >= 0.0, self.half_widths, -self.half_widths)

    def contains(self, point: np.ndarray) -> bool:
        """Returns whether a point, shape (n,), lies inside; comparing floats is exact."""
        return bool((np.abs(point) <= self.half_widths).all())


def _squared(point: np.ndarray) -> Fraction:
    """Returns z'z exactly."""
    return sum((Fraction(float(entry)) ** 2 for entry in point), Fraction(0))
