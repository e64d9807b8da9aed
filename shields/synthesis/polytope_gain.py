"""Gains for polytopes: regulators, and the one that tolerates most."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from ncs_gym import LinearPlant, exact
from ncs_gym.plants.lqr import lqr_gain
from shields.synthesis.design_problem import DesignProblem
from shields.synthesis.invariant_polytope import Feedback
from shields.synthesis.max_margin_gain import MaxMarginGain

# Weights of the inputs, in units of their limits, against those of the states, in units of the box, in the
# linear-quadratic regulators.
_INPUT_WEIGHTS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
# The search for the most tolerant gain tries at most so many gains per entry, fewer where it is asked often, and so
# many in all.
_TRIES_PER_ENTRY, _FEW_TRIES_PER_ENTRY, MOST_TRIES = 25, 8, 200
# From a gain that bears less of the radii than this no better one is sought: searches have gained an eighth.
HOPELESS = 0.8
# Disturbances and errors are summed over so many steps that what is left is smaller than this, next to the first ones;
# over no more steps than the second number.
_LEFT_OVER, _MOST_STEPS = 1e-7, 4000
# They are summed over so many steps at once, a power of two.
_BLOCK = 64
# What a gain needs is found over more steps: it is asked once for each.
_MOST_STEPS_OF_NEEDS = 40_000
# No limit counts as less needed than this, in units of half its range.
_SMALLEST_NEED = 1e-3
# Digits of a tolerated factor: a search takes the same steps on every processor.
_DIGITS = 9


def regulators(plant: LinearPlant) -> list[np.ndarray]:
    """Returns the gains, shape (m, n), of linear-quadratic regulators that use less and less of the inputs.

    Limits of states and inputs together cost as inputs do.
    """
    state, pushed = plant.mixed_rows[:, : plant.n], plant.mixed_rows[:, plant.n :]
    effort, crossed = np.diag(plant.input_half**-2.0) + pushed.T @ pushed, state.T @ pushed
    found = (
        lqr_gain(plant.A, plant.B, plant.weight + weight * state.T @ state, weight * effort, weight * crossed)
        for weight in _INPUT_WEIGHTS
    )
    return [K for K in found if K is not None]


class TolerantGain(NamedTuple):
    """A gain with the factor that all radii may grow by until it keeps no polytope in the box.

    Attributes:
        K: The gain in scaled coordinates, shape (m, n).
        margin: The factor, as far as floats tell.
    """

    K: np.ndarray
    margin: float


def most_tolerant_gain(problem: DesignProblem, start: MaxMarginGain, enough: float = np.inf) -> TolerantGain:
    """Returns the gain that keeps a polytope for the largest radii: Nelder and Mead's search from the ellipsoid's.

    Args:
        problem: The scaled design problem.
        start: The gain that keeps an ellipsoid for the largest radii.
        enough: The search ends once the radii may grow by this factor; one that has such an end is a short one.
    """
    tries = (_TRIES_PER_ENTRY if enough == np.inf else _FEW_TRIES_PER_ENTRY) * start.K.size
    return more_tolerant_gain(start.K, partial(polytope_margin, problem), enough, min(tries, MOST_TRIES))


def more_tolerant_gain(
    K: np.ndarray, margin_of: Callable[[np.ndarray], float], enough: float = np.inf, tries: int = MOST_TRIES
) -> TolerantGain:
    """Returns a gain of larger margin, by Nelder and Mead's search from a given one, shape (m, n).

    Args:
        K: The given one.
        margin_of: The margin of a gain.
        enough: The search ends once the margin is as large.
        tries: The margins of so many gains are computed at most.
    """

    def loss(entries: np.ndarray) -> float:
        return -float(exact.rounded(margin_of(entries.reshape(K.shape)), _DIGITS))

    def stop(intermediate_result: OptimizeResult) -> None:
        if -intermediate_result.fun >= enough:
            raise StopIteration

    found = minimize(loss, K.ravel(), method="Nelder-Mead", callback=stop, options={"maxfev": tries})
    return TolerantGain(found.x.reshape(K.shape), float(-found.fun))


def ellipsoid_margin(problem: DesignProblem, gain: MaxMarginGain, *, input_limits: bool = True) -> float:
    """Returns the factor that all radii may grow by until a gain keeps no ellipsoid in the box.

    Where the box counts between samples, which the search for the gain knows nothing of, a bound from above: at most
    what the gain bears with a polytope, as far as that is known.
    """
    if not len(problem.grid.disturbed):
        return gain.margin
    return min(gain.margin, polytope_margin(problem, gain.K, input_limits=input_limits) or gain.margin)


def polytope_margin(problem: DesignProblem, K: np.ndarray, *, input_limits: bool = True) -> float:
    """Returns the factor that all radii may grow by until a gain keeps no polytope in the box; 0.0 if it is too slow.

    From x = 0 errors and disturbances take c x at most as far as the sum of their supports, step by step, by what the
    closed loop makes of the row c. Where that stays below 1 for the box, at times between samples too if it counts
    there, and for the input limits, the states that stay in them for ever are a set around 0 (Kolmanovsky and Gilbert
    1998, docs/bibliography.md).

    Args:
        problem: The scaled design problem.
        K: The gain, scaled, shape (m, n).
        input_limits: False leaves the input limits out.
    """
    closed_loop = problem.A + problem.B @ K
    radius = float(np.abs(np.linalg.eigvals(closed_loop)).max()) if np.isfinite(closed_loop).all() else np.inf
    steps = np.inf if radius >= 1.0 else np.log(_LEFT_OVER) / np.log(max(radius, 1e-3))
    if steps > _MOST_STEPS:
        return 0.0
    powers = np.eye(problem.n)[None]
    while len(powers) < steps + problem.n:
        powers = np.concatenate([powers, powers @ (powers[-1] @ closed_loop)])
    inputs, (state, pushed, disturbed) = K if input_limits else K[:0], problem.grid
    rows = np.concatenate([problem.C, inputs, state + pushed @ K]) @ powers  # (steps, rows, n)
    used = (_reach(rows @ (problem.B @ K), problem.error_shapes) + _reach(rows, problem.D_u[None])).sum(axis=0)
    used[len(problem.C) :] += _reach(np.concatenate([inputs, pushed @ K]), problem.error_shapes)
    used[len(used) - len(disturbed) :] += disturbed
    return float(exact.rounded(1.0 / max(float(used.max()), 1e-300), _DIGITS))


def needs_of(feedback: Feedback, plant: LinearPlant) -> np.ndarray | None:
    """Returns how far errors and disturbances take the limits from rest under a gain, in units of half their range.

    Shape (k + m + q,), as `polytope_margin` adds them up for the rows of the box, of the inputs and of both together;
    None if it is too slow.
    """
    K, errors, D, _ = feedback
    closed_loop = plant.A + plant.B @ K
    radius = float(np.abs(np.linalg.eigvals(closed_loop)).max()) if np.isfinite(closed_loop).all() else np.inf
    steps = np.inf if radius >= 1.0 else np.log(_LEFT_OVER) / np.log(max(radius, 1e-3))
    if steps > _MOST_STEPS_OF_NEEDS:
        return None
    pushed = plant.mixed_rows[:, plant.n :] @ K
    inputs = K / plant.input_half[:, None]
    moved = np.concatenate([plant.box, inputs, plant.mixed_rows[:, : plant.n] + pushed])
    needs, powers = np.zeros(len(moved)), np.eye(plant.n)[None]
    while len(powers) < _BLOCK:
        powers = np.concatenate([powers, powers @ (powers[-1] @ closed_loop)])
    for _ in range(0, int(steps) + plant.n, _BLOCK):
        later = moved @ powers  # (steps, rows, n)
        needs += (_reach(later @ (plant.B @ K), errors) + _reach(later, D[None])).sum(axis=0)
        moved = later[-1] @ closed_loop
    needs[len(plant.box) :] += _reach(np.concatenate([inputs, pushed]), errors)
    return np.maximum(needs, _SMALLEST_NEED)


def _reach(rows: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Returns the largest support over ellipsoids, shape (l, n, n), of rows, shape (..., n)."""
    n = rows.shape[-1]
    products = (rows[..., :, None] * rows[..., None, :]).reshape(*rows.shape[:-1], n * n)
    squares = products @ shapes.reshape(-1, n * n).T
    return np.sqrt(np.maximum(squares.max(axis=-1), 0.0))
