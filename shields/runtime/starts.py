"""What is known of the states before the first decision of an episode takes effect.

Starts are decided in exact arithmetic. Behind a downlink the inputs of the first c steps are zero, and what is known of
x_1 .. x_c follows from that.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.ellipsoid import outer_sum
from ncs_gym.estimation.kalman_filter import enlarged_by_rounding
from shields.certificate import Certificate
from shields.polytope import Polytope
from shields.runtime.safety_filter import MARGIN, SafetyFilter
from shields.runtime.set_test import PredictedErrors
from shields.verification.rational_matrix import (
    is_positive_semidefinite,
    multiply,
    quadratic,
    rational,
    subtract,
    transpose,
)

# Relative rounding of one step of a center, per dimension.
CENTER_ROUNDING = 8.0 * float(np.finfo(float).eps)


class StartKnown(NamedTuple):
    """What is known of the start of an episode before any estimate.

    Attributes:
        in_safe_set: Whether every possible start lies in S, the certificate's safe set.
        in_box: Whether every possible start lies in the safe box; in modes without plans, in the safe set.
    """

    in_safe_set: bool
    in_box: bool


def starts_inside(certificate: Certificate, initial: Ellipsoid | np.ndarray) -> bool:
    """Returns whether all possible starts lie in the safe set of a certificate, decided in exact arithmetic.

    Args:
        certificate: Gives S.
        initial: An ellipsoid E(X), inside S exactly if L - X >= 0; or a single state, shape (n,), inside S exactly if
            [1, x'; x, L] >= 0. Either is inside a polytope exactly if it is between all its pairs of faces.
    """
    S = certificate.safe_set
    if isinstance(S, Polytope):
        return _between(S.rows, S.low, S.high, initial)
    L = rational(S.shape_matrix)
    if isinstance(initial, Ellipsoid):
        return is_positive_semidefinite(subtract(L, rational(initial.shape_matrix)))
    state = rational(initial)[0]
    one = rational(np.ones(1))[0]
    return is_positive_semidefinite([one + state] + [[x, *row] for x, row in zip(state, L, strict=True)])


def starts_in_box(plant: LinearPlant, initial: Ellipsoid | np.ndarray) -> bool:
    """Returns whether all starts in an ellipsoid, or one state, shape (n,), lie in the safe box, in exact arithmetic.

    Where the box counts between samples, they have to lie in a smaller one, in which disturbances cannot leave it.
    """
    low, high = plant.kept_ends
    return _between(plant.box, low, high, initial)


def _between(rows: np.ndarray, low: np.ndarray, high: np.ndarray, initial: Ellipsoid | np.ndarray) -> bool:
    """Returns whether low <= g x <= high for all rows g, shape (r, n), and all x in an ellipsoid, or one state."""
    if not isinstance(initial, Ellipsoid) and (verdict := _quick_verdict(rows, low, high, initial)) is not None:
        return verdict  # a thousand times faster than in rational arithmetic
    given, ends = rational(rows), list(zip(low.tolist(), high.tolist(), strict=True))
    if isinstance(initial, Ellipsoid):
        shape = rational(initial.shape_matrix)
        nearest = [min(-lo, hi) for lo, hi in ends]  # exact: none of them rounds
        return all(
            near > 0.0 and quadratic([row], shape) <= Fraction(near) ** 2
            for row, near in zip(given, nearest, strict=True)
        )
    products = multiply(given, transpose(rational(initial)))
    return all(lo <= product <= hi for (product,), (lo, hi) in zip(products, ends, strict=True))


def _quick_verdict(rows: np.ndarray, low: np.ndarray, high: np.ndarray, state: np.ndarray) -> bool | None:
    """Returns whether low <= g x <= high for all rows and one state; None where rounding could decide it."""
    products, sizes = rows @ state, np.abs(rows) @ np.abs(state)
    rounding = (len(state) + 2) * float(np.finfo(float).eps) * sizes + float(np.finfo(float).tiny)
    if ((low <= products - rounding) & (products + rounding <= high)).all():
        return True
    return False if ((products + rounding < low) | (products - rounding > high)).any() else None


def starts_known(
    safety_filter: SafetyFilter, initial: Ellipsoid | np.ndarray | None, input_delay: int
) -> tuple[StartKnown, ...]:
    """Returns what is known of x_0 .. x_c, given possible starts: an ellipsoid, one state, shape (n,), or None for any.

    x_0 is decided in exact arithmetic. With x_0 in {z} + E(P), x_1 lies in {A z} + E(A P A'/nu + D/(1-nu)) for every nu
    in (0, 1), and so on; whether that lies in the safe set, or in the box, is decided by the tests that judge
    estimates, with their margins for rounding.
    """
    if initial is None:
        return (StartKnown(False, False),) * (input_delay + 1)
    plant, inside = safety_filter.plant, starts_inside(safety_filter.certificate, initial)
    in_box = inside or (safety_filter.mode == "lookahead" and starts_in_box(plant, initial))
    known = [StartKnown(inside, in_box)]
    if isinstance(initial, Ellipsoid):
        center, shape = np.zeros(plant.n), initial.shape_matrix
    else:
        center, shape = np.asarray(initial, dtype=np.float64), np.zeros((plant.n, plant.n))
    for ahead in range(input_delay):
        if not safety_filter.test.keeps_within_step(center, safety_filter.errors_of(shape), MARGIN):
            known[ahead] = StartKnown(False, False)
        center, shape = _moved(plant, center, shape)
        errors = safety_filter.errors_of(shape)
        inside = bool(safety_filter.test.knows_inside(center, errors, MARGIN))
        known.append(StartKnown(inside, inside or _knows_in_box(safety_filter, center, errors)))
    return tuple(known)


def known_inside(safety_filter: SafetyFilter, known: StartKnown, estimate: np.ndarray, errors: PredictedErrors) -> bool:
    """Returns whether one of x_0 .. x_{c-1}, after which the input is zero, is known to be in the safe set, or box.

    Either from where starts are possible, or from its estimate, shape (n,).
    """
    if known.in_box:
        return True
    if not safety_filter.test.keeps_within_step(estimate, errors, MARGIN):
        return False
    inside = bool(safety_filter.test.knows_inside(estimate, errors, MARGIN))
    return inside or _knows_in_box(safety_filter, estimate, errors)


def first_store(
    safety_filter: SafetyFilter, estimate: np.ndarray, errors: PredictedErrors, known: StartKnown
) -> tuple[np.ndarray, bool]:
    """Returns what is stored before the first decision, shape (k, m), and whether the state is proved safe.

    The state is that at which the first decision takes effect. It is proved safe where it is known to be in the safe
    set; in mode "lookahead" also where it is known to be in the box, by what starts are possible or by the estimate,
    shape (n,), and a first plan is certified.
    """
    inside = known.in_safe_set or safety_filter.test.knows_inside(estimate, errors, MARGIN)
    if inside:
        return np.empty((0, safety_filter.plant.m)), known.in_safe_set
    plan = safety_filter.first_plan(estimate, errors)
    in_box = len(plan) > 0 and (known.in_box or _knows_in_box(safety_filter, estimate, errors))
    return plan, in_box


def _knows_in_box(safety_filter: SafetyFilter, estimate: np.ndarray, errors: PredictedErrors) -> bool:
    """Returns whether an estimate, shape (n,), proves that x is in the box; without plans that proves nothing."""
    lookahead = safety_filter.lookahead
    return lookahead is not None and lookahead.knows_in_box(estimate, errors)


def _moved(plant: LinearPlant, center: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns center and shape one step later under no input, enlarged by the rounding of both."""
    size = np.abs(plant.A)
    carried = enlarged_by_rounding(plant.A @ shape @ plant.A.T, size @ np.sqrt(np.maximum(shape.diagonal(), 0.0)))
    rounding = CENTER_ROUNDING * plant.n * (size @ np.abs(center))
    spread = outer_sum(plant.disturbance.shape_matrix, plant.n * np.diag(rounding**2), plant.weight)
    moved = outer_sum(carried, spread, plant.weight)
    return plant.A @ center, 0.5 * (moved + moved.T)
