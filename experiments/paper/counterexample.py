"""Steps that leave a set, looked for in floating point and confirmed in exact arithmetic, and proofs that none does."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from operator import itemgetter

import numpy as np

from ncs_gym import Ellipsoid
from shields.verification.rational_matrix import (
    Matrix,
    add,
    congruence,
    is_positive_semidefinite,
    multiply,
    quadratic,
    rational,
    scale,
    subtract,
    to_float,
    transpose,
)

# Factor that pulls the points found into their sets by more than rounding.
_INSIDE = 1.0 - 1e-9
# Digits that a step is shown with, if it leaves the set with these alone.
_DECIMALS = 4
_STARTS, _ASCENT_STEPS = 200, 200


@dataclass(frozen=True, eq=False)
class Ball:
    """{z : z'z <= squared_radius}, the set Delta(squared_radius) of (3), or its diameter along a vector, shape (n,)."""

    squared_radius: float
    along: np.ndarray | None = None

    def extreme_point(self, slope: np.ndarray) -> np.ndarray:
        """Returns the point farthest along a slope, shape (n,)."""
        outwards = slope if self.along is None else self.along * (1.0 if self.along @ slope >= 0.0 else -1.0)
        length = np.linalg.norm(outwards)
        return self.squared_radius**0.5 * outwards / length if length > 0.0 else np.zeros_like(slope)

    def contains(self, point: np.ndarray) -> bool:
        """Returns whether a point, shape (n,), lies inside, in exact arithmetic; rounding off a line is allowed."""
        return _squared(point) <= Fraction(self.squared_radius)

    def exact_shape(self, n: int) -> Matrix:
        """Returns P with {z : a'z <= sqrt(a'Pa) for all a} the set, as rational numbers."""
        if self.along is None:
            return scale(Fraction(self.squared_radius), rational(np.eye(n)))
        factor, entries = Fraction(self.squared_radius) / _squared(self.along), rational(self.along)[0]
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


@dataclass(frozen=True, eq=False)
class OneStep:
    """The worst step x, d, e to x+ = (A+BK) x + d + e that was found; in few digits if it leaves the set with these.

    Attributes:
        state, disturbance, error, following: x, d, e and x+, shape (n,).
        level: x+'M x+ in floating point.
        confirmed: Whether exact arithmetic confirms x in S, d and e in their sets, and x+ outside S.
    """

    state: np.ndarray
    disturbance: np.ndarray
    error: np.ndarray
    following: np.ndarray
    level: float
    confirmed: bool


def worst_step(
    closed: np.ndarray, M: np.ndarray, disturbances: Ball | Box, errors: Ball, *, starts: int = _STARTS
) -> OneStep:
    """Returns the step from {x'Mx <= 1} that ends at the largest x+'M x+.

    It is found by ascent from random slopes: for a fixed slope M x+ each of x, d, e is the extreme point of its set.
    `closed` is A + B K, shape (n, n).
    """
    inverse = np.linalg.inv(M)
    states = Ellipsoid(0.5 * (inverse + inverse.T))
    rng = np.random.default_rng(0)

    def ascended() -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        slope = rng.standard_normal(len(M))
        for _ in range(_ASCENT_STEPS):
            x = states.extreme_point(closed.T @ slope)
            d, e = disturbances.extreme_point(slope), errors.extreme_point(slope)
            end = closed @ x + d + e
            slope = M @ end
        return float(end @ M @ end), x, d, e

    level, x, d, e = max((ascended() for _ in range(starts)), key=itemgetter(0))
    inside = tuple(np.asarray(_INSIDE * point) for point in (x, d, e))
    nearest = tuple(np.round(point, _DECIMALS) for point in inside)
    inward = tuple(np.trunc(point * 10**_DECIMALS) / 10**_DECIMALS for point in inside)

    def is_confirmed(points: tuple[np.ndarray, ...]) -> bool:
        x, d, e = points
        return disturbances.contains(d) and errors.contains(e) and _leaves(closed, M, x, d, e)

    x, d, e = next(filter(is_confirmed, (nearest, (inward[0], *nearest[1:]), inward)), inside)
    return OneStep(x, d, e, closed @ x + d + e, level, is_confirmed((x, d, e)))


def stays_inside(closed: np.ndarray, M: np.ndarray, disturbances: Ball, errors: Ball) -> bool:
    """Returns whether exact arithmetic proves that no such step leaves the set (False: not proved).

    With P the closed loop's image of M^-1 and the shapes of e and d, any weights that sum to 1 give an ellipsoid around
    the sum of the three; it lies in {x'Mx <= 1} if M - M (sum of P_i / weight_i) M >= 0. Arguments as in `worst_step`.
    """
    n, exact_M = len(M), rational(M)
    others = [errors.exact_shape(n), disturbances.exact_shape(n)]
    shapes = [closed @ np.linalg.inv(M) @ closed.T, *map(to_float, others)]
    weights = [Fraction(float(np.sqrt(np.trace(M @ shape)))) for shape in shapes]
    total = sum(weights)
    # M (closed M^-1 closed') M <= weight_1 (M - rest): by Schur, in M and closed alone.
    rest = exact_M
    for shape, weight in zip(others, weights[1:], strict=True):
        rest = subtract(rest, scale(total / weight, congruence(exact_M, shape)))
    image = multiply(exact_M, rational(closed))
    top = [left + right for left, right in zip(scale(weights[0] / total, exact_M), transpose(image), strict=True)]
    bottom = [left + right for left, right in zip(image, rest, strict=True)]
    return is_positive_semidefinite(top + bottom)


def _leaves(closed: np.ndarray, M: np.ndarray, x: np.ndarray, d: np.ndarray, e: np.ndarray) -> bool:
    """Returns whether the step starts in S and ends outside, in rational arithmetic."""
    exact_x, exact_d, exact_e, exact_M = (rational(value) for value in (x, d, e, M))
    following = add(multiply(exact_x, transpose(rational(closed))), exact_d, exact_e)
    return quadratic(exact_x, exact_M) <= 1 < quadratic(following, exact_M)


def contracts(closed: np.ndarray, M: np.ndarray) -> bool:
    """Returns whether (A+BK)'M(A+BK) <= M, which is (C1) at kappa = 1, in exact arithmetic."""
    exact_M = rational(M)
    return is_positive_semidefinite(subtract(exact_M, congruence(transpose(rational(closed)), exact_M)))


def _squared(point: np.ndarray) -> Fraction:
    return sum((Fraction(float(entry)) ** 2 for entry in point), Fraction(0))


@dataclass(frozen=True)
class OnlyIfExample:
    """A set, a closed loop and bounds on which to try the "only if" of Theorem 5, in rational numbers.

    Attributes:
        M: Matrix of the set {x : x'Mx <= 1}, diagonal.
        closed_loop: A + B K.
        radius: The square root of gamma, and of epsilon.
        state: A state x of the set, a row, whose image shows how large kappa must be for (Cond.A).
        witness: A point z with z'Mz <= that kappa, a row, from which d + e along `outwards` leave the set.
        outwards: Unit vector, a row.
        weight: Weight of the closed loop's image in the ellipsoid around the sum, in (0, 1).
    """

    M: Matrix
    closed_loop: Matrix
    radius: Fraction
    state: Matrix
    witness: Matrix
    outwards: Matrix
    weight: Fraction

    @property
    def is_invariant(self) -> bool:
        """Whether image / weight + ball / (1 - weight) proves the set invariant, with d + e in the ball of 2 radius."""
        size = len(self.M)
        shape = [[1 / self.M[i][i] if i == j else Fraction(0) for j in range(size)] for i in range(size)]
        identity = [[Fraction(i == j) for j in range(size)] for i in range(size)]
        image = scale(1 / self.weight, congruence(self.closed_loop, shape))
        ball = scale((2 * self.radius) ** 2 / (1 - self.weight), identity)
        return is_positive_semidefinite(subtract(subtract(shape, image), ball))

    @property
    def least_kappa(self) -> Fraction:
        """The kappa that (Cond.A) needs at least, from `state`."""
        image = multiply(self.state, transpose(self.closed_loop))
        return quadratic(image, self.M) / quadratic(self.state, self.M)

    @property
    def witness_level(self) -> Fraction:
        """(z + d + e)'M(z + d + e) at the witness of (Cond.B)."""
        return quadratic(add(self.witness, scale(2 * self.radius, self.outwards)), self.M)

    @property
    def breaks_condition(self) -> bool:
        """Whether every kappa that meets (Cond.A) breaks (Cond.B)."""
        return quadratic(self.witness, self.M) <= self.least_kappa and self.witness_level > 1


def _diagonal(first: Fraction, second: Fraction) -> Matrix:
    return [[first, Fraction(0)], [Fraction(0), second]]


ONLY_IF = OnlyIfExample(
    M=_diagonal(Fraction(1), Fraction(100)),
    closed_loop=_diagonal(Fraction(9, 10), Fraction(0)),
    radius=Fraction(1, 50),
    state=[[Fraction(1), Fraction(0)]],
    witness=[[Fraction(0), Fraction(9, 100)]],
    outwards=[[Fraction(0), Fraction(1)]],
    weight=Fraction(5, 6),
)
