"""Looks for a state, disturbance and error that leave a set in one step, and confirms it exactly."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from operator import itemgetter

import numpy as np

from experiments.paper.sets import Ball, Box, Segment
from ncs_gym import Ellipsoid
from shields.verification.rational_matrix import (
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
class OneStep:
    """The worst step of the closed loop that was found; in few digits if it leaves the set with these, too.

    Attributes:
        state: x, shape (n,).
        disturbance: d, shape (n,).
        error: e, shape (n,).
        following: x+ = (A+BK) x + d + e, shape (n,).
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
    closed: np.ndarray, M: np.ndarray, disturbances: Ball | Box, errors: Ball | Segment, *, starts: int = _STARTS
) -> OneStep:
    """Returns the step from {x'Mx <= 1} that ends at the largest x+'M x+.

    It is found by ascent from random slopes: for a fixed slope M x+ each of x, d, e is the extreme point of its set.

    Args:
        closed: State matrix of the closed loop, A + B K, shape (n, n).
        M: Matrix of the safe set, shape (n, n).
        disturbances: The set of d.
        errors: The set of e.
        starts: Number of random slopes.
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


def stays_inside(closed: np.ndarray, M: np.ndarray, disturbances: Ball, errors: Ball | Segment) -> bool:
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
