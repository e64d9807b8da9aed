"""What is known of the states x_0 .. x_c before the first decision of an episode takes effect: the inputs are zero."""

from __future__ import annotations

import numpy as np

from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.estimation.set_membership import enlarged_by_rounding
from ncs_gym.uncertainty.shape_matrices import outer_sum
from shields.runtime.guarantee import LoopObservation, StartKnown, start_known
from shields.runtime.predicted_errors import PredictedErrors
from shields.runtime.safety_filter import MARGIN, SafetyFilter

# Relative rounding of one step of a center, per dimension.
CENTER_ROUNDING = 8.0 * float(np.finfo(float).eps)


def starts_known(
    safety_filter: SafetyFilter, initial: Ellipsoid | np.ndarray | None, lead: int
) -> tuple[StartKnown, ...]:
    """Returns what is known of x_0 .. x_c, given where starts are possible.

    x_0 is decided in exact arithmetic. With x_0 in {z} + E(P), x_1 lies in {A z} + E(A P A'/nu + D/(1-nu)) for every nu
    in (0, 1), and so on; whether that lies in S, or in the box, is decided by the tests that judge estimates, with
    their margins for rounding.

    Args:
        safety_filter: Gives S, the box and the plant.
        initial: An ellipsoid, one state, shape (n,), or None for any start.
        lead: c.
    """
    known = [start_known(safety_filter, initial)]
    if initial is None:
        return tuple(known * (lead + 1))
    plant = safety_filter.plant
    if isinstance(initial, Ellipsoid):
        center, shape = np.zeros(plant.n), initial.shape
    else:
        center, shape = np.asarray(initial, dtype=np.float64), np.zeros((plant.n, plant.n))
    for _ in range(lead):
        center, shape = _moved(plant, center, shape)
        errors = safety_filter.errors_of(shape)
        inside = bool(safety_filter.test.knows_inside(center, errors, MARGIN))
        known.append(StartKnown(inside, inside or _in_box(safety_filter, center, errors)))
    return tuple(known)


def known_inside(safety_filter: SafetyFilter, known: StartKnown, estimate: np.ndarray, errors: PredictedErrors) -> bool:
    """Returns whether one of the states x_0 .. x_{c-1} is known to be in S; in mode "lookahead" in the box.

    Args:
        safety_filter: Gives S and the box.
        known: What is known of it from where starts are possible.
        estimate: Its estimate, shape (n,).
        errors: What is known of the error shape of that.
    """
    if known.in_safe_set or bool(safety_filter.test.knows_inside(estimate, errors, MARGIN)):
        return True
    return safety_filter.lookahead is not None and (known.in_box or _in_box(safety_filter, estimate, errors))


def first_observations(
    safety_filter: SafetyFilter,
    known: list[tuple[StartKnown, ...]],
    beliefs: list[tuple[np.ndarray, PredictedErrors]],
) -> list[tuple[np.ndarray, LoopObservation]]:
    """Returns of x_0 .. x_{c-1} in k environments whether each is known to be inside, (k,), and what is observed.

    Args:
        safety_filter: Gives S and the box.
        known: What is known of x_0 .. x_c in each of the environments from where its starts are possible.
        beliefs: Of x_0 .. x_{c-1}, estimates, shape (n, k), and what is known of the error shapes.
    """
    found = []
    for ahead, (estimates, errors) in enumerate(beliefs):
        each = (errors.of(np.array([e])).single() for e in range(len(known)))
        columns = np.ascontiguousarray(estimates.T)
        inside = [
            known_inside(safety_filter, start[ahead], estimate, own)
            for start, estimate, own in zip(known, columns, each, strict=True)
        ]
        no_alarm = np.zeros(len(known), np.bool_)
        found.append((np.array(inside, np.bool_), LoopObservation(estimates, errors, no_alarm)))
    return found


def _in_box(safety_filter: SafetyFilter, center: np.ndarray, errors: PredictedErrors) -> bool:
    """Returns whether {center} + E(shape) lies in the box; only mode "lookahead" asks."""
    return safety_filter.lookahead is not None and safety_filter.lookahead.knows_in_box(center, errors)


def _moved(plant: LinearPlant, center: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns center and shape one step later under no input, with room for the rounding of both."""
    size = np.abs(plant.A)
    carried = enlarged_by_rounding(plant.A @ shape @ plant.A.T, size @ np.sqrt(np.maximum(shape.diagonal(), 0.0)))
    rounding = CENTER_ROUNDING * plant.n * (size @ np.abs(center))
    spread = outer_sum(plant.disturbance.shape, plant.n * np.diag(rounding**2), plant.weight)
    moved = outer_sum(carried, spread, plant.weight)
    return plant.A @ center, 0.5 * (moved + moved.T)
