"""The point at which a fallback input rests, for plants whose limits are not symmetric about their operating point."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import linprog

from ncs_gym import LinearPlant, exact
from ncs_gym.ellipsoid import inflated, outer_sum
from ncs_gym.plants.linear_plant import weight_of
from ncs_gym.plants.lqr import lqr_gain
from shields.errors import Infeasible
from shields.synthesis.design_problem import Rest, SymmetricLimits

# Significant digits of a resting point, in units of the limits: what differs between processors is beyond them.
_DIGITS = 12
# The search for a better point takes steps of these sizes along every direction of the equilibria, in units of the
# distance at which some limit is reached, as long as one of them helps.
_STEPS = (0.4, 0.2, 0.1, 0.05, 0.02)
_MOST_TURNS = 6
# How far a state without a limit is taken to go while a gain is sought, next to where a regulator lets it go.
_GENEROUS = 2.0
_STEPS_OF_REACH = 400
# What limits see of a direction less than this, in which they are about 1 away, is rounding.
_UNSEEN = 1e-9
# What an equilibrium lacks is computed with an error of at most this, relative to its terms.
_OF_REST = 1e-14
# A limit binds if more of what all nearest ones leave is due to it.
_LEAST_PRICE = 1e-3


def at_operating_point(plant: LinearPlant) -> Rest:
    """Returns where fallbacks of plants with symmetric limits rest: zero."""
    return Rest(np.zeros(plant.n), np.zeros(plant.m))


def equilibria(plant: LinearPlant) -> np.ndarray:
    """Returns directions (x, u) with x = A x + B u, shape (n + m, q), in which every limit is about 1 away."""
    scale = np.concatenate([plant.half_widths, plant.input_half])
    balance = np.hstack([plant.A - np.eye(plant.n), plant.B]) / plant.half_widths[:, None]
    return scale[:, None] * null_space(balance * scale)


class LimitRows(NamedTuple):
    """Limits low <= rows (x, u) <= high, (r, n + m), in units of half their range: box, inputs, within a step."""

    rows: np.ndarray
    low: np.ndarray
    high: np.ndarray


def limit_rows(plant: LinearPlant) -> LimitRows:
    """Returns the limits that proofs for a plant keep."""
    box = np.hstack([plant.box, np.zeros((len(plant.box), plant.m))])
    inputs = np.hstack([np.zeros((plant.m, plant.n)), np.diag(1.0 / plant.input_half)])
    rows = np.concatenate([box, inputs, plant.step_rows])
    ends = np.concatenate([plant.kept_ends, plant.input_ends / plant.input_half, plant.step_ends], axis=1)
    return LimitRows(rows, *ends)


def around(limits: LimitRows, rest: Rest) -> LimitRows:
    """Returns the limits of deviations from a point."""
    reached = limits.rows @ np.concatenate(rest)
    return limits._replace(low=limits.low - reached, high=limits.high - reached)


def needs_resting_point(plant: LinearPlant) -> bool:
    """Returns whether limits are not symmetric about the operating point, or leave a state free."""
    low, high = limit_rows(plant)[1:]
    return not np.array_equal(-low, high) or exact.rank(plant.box) < plant.n


class Farthest(NamedTuple):
    """An equilibrium, its distance from the nearest limits in units of what is needed, and the numbers of these."""

    rest: Rest
    distance: float
    binding: np.ndarray


def farthest_equilibrium(
    plant: LinearPlant, needs: np.ndarray | None = None, limits: LimitRows | None = None
) -> Farthest:
    """Returns the equilibrium whose nearest limit is farthest away, by a linear program.

    Distances from the limits, by default those of `limit_rows`, are in units of `needs`, by default of half the range.

    Raises:
        Infeasible: If no equilibrium is strictly within the limits.
    """
    directions, (rows, low, high) = equilibria(plant), limits or limit_rows(plant)
    reached, needed = rows @ directions, np.ones((len(rows), 1)) if needs is None else needs[:, None]
    above, below = np.isfinite(high), np.isfinite(low)
    faces = np.concatenate([np.hstack([reached, needed])[above], np.hstack([-reached, needed])[below]])
    ends = np.concatenate([high[above], -low[below]])
    size = directions.shape[1]
    found = linprog(-np.eye(size + 1)[-1], A_ub=faces, b_ub=ends, bounds=[(None, None)] * (size + 1))
    if found.status != 0 or not found.x[-1] > 0.0:
        raise Infeasible("no equilibrium lies strictly within the limits of states and inputs", "S", 1.0)
    numbers = np.concatenate([np.flatnonzero(above), np.flatnonzero(below)])
    prices = -found.ineqlin.marginals * needed[numbers, 0]  # they add up to 1
    binding = np.unique(numbers[prices > _LEAST_PRICE])
    # Where no limit sees a direction, such as a position, it is the equilibrium nearest to the operating point.
    units = np.concatenate([plant.half_widths, plant.input_half])[:, None]
    point, unseen = directions @ found.x[:-1], directions @ null_space(reached, rcond=_UNSEEN)
    point = point - unseen @ np.linalg.lstsq(unseen / units, point / units[:, 0])[0]
    return Farthest(rest_at(plant, point), float(found.x[-1]), binding)


def rest_at(plant: LinearPlant, point: np.ndarray) -> Rest:
    """Returns a point (x, u), shape (n + m,), in round numbers."""
    scale = np.concatenate([plant.half_widths, plant.input_half])
    rounded = np.array(
        [float(exact.rounded(each / unit, _DIGITS)) * unit for each, unit in zip(point, scale, strict=True)]
    )
    return Rest(rounded[: plant.n], rounded[plant.n :])


def distances(plant: LinearPlant, rest: Rest) -> np.ndarray:
    """Returns how far a point is from the nearer end of every limit of `limit_rows`, in units of half its range."""
    ends = around(limit_rows(plant), rest)
    return np.minimum(-ends.low, ends.high)


def limits_around(plant: LinearPlant, rest: Rest) -> SymmetricLimits:
    """Returns the largest symmetric limits around a point, with generous ones of states that have none.

    Raises:
        Infeasible: If the point is not strictly within the limits.
    """
    nearest = distances(plant, rest)
    if not (nearest > 0.0).all():
        raise Infeasible("the resting point is not strictly within the limits of states and inputs", "S", 1.0)
    k = len(plant.box)
    rows, u_max = plant.box / nearest[:k, None], plant.input_half * nearest[k : k + plant.m]
    if exact.rank(plant.box) < plant.n:
        rows = np.concatenate([rows, _generous_rows(plant, rows, u_max)])
    return SymmetricLimits(rows, u_max)


def disturbance_around(plant: LinearPlant, rest: Rest) -> np.ndarray:
    """Returns D with what a resting point lacks of an equilibrium, shape (n, n)."""
    missing = plant.A @ rest.state + plant.B @ rest.input - rest.state
    D = plant.disturbance.shape_matrix
    if missing.any():
        missing = np.abs(missing) + _OF_REST * (np.abs(plant.A) @ np.abs(rest.state) + np.abs(rest.state))
        D = outer_sum(D, plant.n * np.diag(missing**2), plant.relative_weight)
    return inflated(D)


def units_of_states(plant: LinearPlant, rest: Rest) -> np.ndarray:
    """Returns the size of each state, shape (n,): the plant's half-widths, or if some are free of `limits_around`."""
    if exact.rank(plant.box) == plant.n:
        return plant.half_widths
    rows = limits_around(plant, rest).box_rows
    return np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))


def _generous_rows(plant: LinearPlant, rows: np.ndarray, u_max: np.ndarray) -> np.ndarray:
    """Returns rows that limit every state which no row limits alone, (j, n), about to where a regulator lets it go."""
    free = np.flatnonzero(
        [not any(np.count_nonzero(row) == 1 and row[i] != 0.0 for row in rows) for i in range(plant.n)]
    )
    K = lqr_gain(plant.A, plant.B, weight_of(rows, plant.reach_from_rest), np.diag(u_max**-2.0))
    reach = plant.half_widths
    if K is not None:
        # Of the states from which the undisturbed regulator keeps all rows and inputs, over these steps.
        seen, power, reached = np.vstack([rows, K / u_max[:, None]]), np.eye(plant.n), []
        for _ in range(_STEPS_OF_REACH):
            reached.append(seen @ power)
            power = (plant.A + plant.B @ K) @ power
        stacked = np.concatenate(reached)
        if np.linalg.matrix_rank(stacked / np.maximum(np.abs(stacked).max(axis=0), 1e-300)) == plant.n:
            reach = np.array([_farthest(stacked, i) for i in range(plant.n)])
    widths = np.where(np.isfinite(reach), _GENEROUS * reach, plant.half_widths)
    return np.diag(1.0 / widths)[free]


def _farthest(rows: np.ndarray, i: int) -> float:
    """Returns the largest x_i with |rows x| <= 1, by a linear program; infinite where there is none."""
    unit = 1.0 / np.maximum(np.abs(rows).max(axis=0), 1e-300)
    scaled = rows * unit
    found = linprog(
        -np.eye(len(unit))[i], A_ub=np.concatenate([scaled, -scaled]), b_ub=np.ones(2 * len(rows)), bounds=(None, None)
    )
    return -found.fun * float(unit[i]) if found.status == 0 else np.inf


def improved(plant: LinearPlant, rest: Rest, share: Callable[[Rest], float]) -> Rest:
    """Returns an equilibrium with a larger share of the box, by a search along one direction after the other."""
    directions, best, most = equilibria(plant), rest, share(rest)
    for step in _STEPS:
        for _ in range(_MOST_TURNS):
            before = most
            for direction in directions.T:
                for sign in (1.0, -1.0):
                    tried = rest_at(plant, np.concatenate(best) + sign * step * direction)
                    if (distances(plant, tried) > 0.0).all() and (found := share(tried)) > most:
                        best, most = tried, found
            if most == before:
                break
    return best
