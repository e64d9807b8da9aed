"""Looks for a state, disturbance and error that leave a set in one step, and confirms it exactly."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from operator import itemgetter

import numpy as np

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
    transpose,
)

# Factor that pulls the points found into their sets by more than rounding.
_INSIDE = 1.0 - 1e-9
_STARTS, _ASCENT_STEPS = 200, 200


@dataclass(frozen=True, eq=False)
class OneStep:
    """The worst step of the closed loop that was found.

    Attributes:
        state: x, shape (n,).
        disturbance: d, shape (n,).
        error: e, shape (n,).
        following: x+ = (A+BK) x + d + e, shape (n,).
        level: x+'M x+ in floating point.
        confirmed: Whether exact arithmetic confirms x in S, d'd <= gamma, e'e <= eps and x+ outside S.
    """

    state: np.ndarray
    disturbance: np.ndarray
    error: np.ndarray
    following: np.ndarray
    level: float
    confirmed: bool


def worst_step(
    closed: np.ndarray, M: np.ndarray, gamma: float, epsilon: float, direction: np.ndarray | None = None
) -> OneStep:
    """Returns the step from {x'Mx <= 1} with d'd <= gamma, e'e <= epsilon that ends at the largest x+'M x+.

    It is found by ascent from random starts: for a fixed slope M x+ each of x, d, e is the extreme point of its set.

    Args:
        closed: State matrix of the closed loop, A + B K, shape (n, n).
        M: Matrix of the safe set, shape (n, n).
        gamma: Largest d'd.
        epsilon: Largest e'e.
        direction: Vector along which e lies, shape (n,); None for every e in the ball.
    """
    n = len(M)
    inverse = np.linalg.inv(M)
    states, disturbances = Ellipsoid(0.5 * (inverse + inverse.T)), Ellipsoid(gamma * np.eye(n))
    spread = np.eye(n) if direction is None else np.outer(direction, direction) / (direction @ direction)
    errors = Ellipsoid(epsilon * spread)
    rng = np.random.default_rng(0)

    def ascended() -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        x, d, e = (source.sample_boundary(rng) for source in (states, disturbances, errors))
        for _ in range(_ASCENT_STEPS):
            slope = M @ (closed @ x + d + e)
            x, d, e = (
                states.extreme_point(closed.T @ slope),
                disturbances.extreme_point(slope),
                errors.extreme_point(slope),
            )
        end = closed @ x + d + e
        return float(end @ M @ end), _INSIDE * x, _INSIDE * d, _INSIDE * e

    level, x, d, e = max((ascended() for _ in range(_STARTS)), key=itemgetter(0))
    return OneStep(x, d, e, closed @ x + d + e, level, _confirmed(closed, M, gamma, epsilon, x, d, e))


def stays_inside(
    closed: np.ndarray, M: np.ndarray, gamma: float, epsilon: float, direction: np.ndarray | None = None
) -> bool:
    """Returns whether exact arithmetic proves that no such step leaves the set (False: not proved).

    With P the closed loop's image of M^-1, e's shape and gamma I, any weights that sum to 1 give an ellipsoid around
    the sum of the three; it lies in {x'Mx <= 1} if M - M (sum of P_i / weight_i) M >= 0. Arguments as in `worst_step`.
    """
    n = len(M)
    inverse = np.linalg.inv(M)
    spread = np.eye(n) if direction is None else np.outer(direction, direction)
    shapes = [closed @ inverse @ closed.T, epsilon * spread / (1.0 if direction is None else direction @ direction)]
    sizes = np.sqrt([np.trace(M @ shape) for shape in (*shapes, gamma * np.eye(n))])
    weights = [Fraction(float(size)) for size in sizes]
    total = sum(weights)
    M_, closed_ = rational(M), multiply(rational(M), rational(closed))
    # M (closed M^-1 closed') M <= weight_1 (M - rest): by Schur, in M and closed alone.
    square = Fraction(1) if direction is None else quadratic(rational(direction), rational(np.eye(n)))
    terms = [
        (Fraction(epsilon) / square, rational(spread), weights[1]),
        (Fraction(gamma), rational(np.eye(n)), weights[2]),
    ]
    rest = M_
    for factor, shape, weight in terms:
        rest = subtract(rest, scale(factor * total / weight, congruence(M_, shape)))
    top = [left + right for left, right in zip(scale(weights[0] / total, M_), transpose(closed_), strict=True)]
    bottom = [left + right for left, right in zip(closed_, rest, strict=True)]
    return is_positive_semidefinite(top + bottom)


def _confirmed(closed, M, gamma, epsilon, x, d, e) -> bool:
    """Returns whether the step starts inside all bounds and ends outside S, in rational arithmetic."""
    x_, d_, e_, M_ = (rational(value) for value in (x, d, e, M))
    following = add(multiply(x_, transpose(rational(closed))), d_, e_)
    identity = rational(np.eye(len(M)))
    return (
        quadratic(x_, M_) <= 1
        and quadratic(d_, identity) <= Fraction(gamma)
        and quadratic(e_, identity) <= Fraction(epsilon)
        and quadratic(following, M_) > 1
    )
