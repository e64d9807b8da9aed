"""A design in round numbers: nearly the largest one, and the same whichever processor searched for it.

A solver's answer is exact to about the square root of its tolerance, and processors differ in what remains. So the
search only says *where* the largest set is, in a few digits. The set is then found anew as the minimum of a smooth,
strictly convex function, the logarithmic barrier of the same conditions. Newton's method finds that to nearly all
digits of float64, so that rounding it gives the same numbers almost everywhere. Exact verification judges the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from ncs_gym import exact
from shields.synthesis.design_problem import CandidateDesign, DesignProblem
from shields.synthesis.initial_designs import VOLUME_TOLERANCE, multiplier_triple
from shields.synthesis.invariant_set_program import InvariantSetProgram
from shields.synthesis.multipliers import best_input_multipliers, best_multipliers, with_best_multipliers
from shields.verification import ACTION_ROUNDING

# Digits of the search's set, and steps of the logarithms of ratios of its multipliers: more where few do not suffice.
_SEARCHED_DIGITS, _SEARCHED_STEPS = (2, 3, 4), (0.1, 0.01, 0.001)
# The multipliers lx and le / (1 - lx), and mu, that are tried where the found set nearly fills the box.
_FULL_BOX_MULTIPLIERS, _FULL_BOX_INPUTS = ((0.85, 0.3), (0.92, 0.1), (0.97, 0.2)), 0.8
# A design may have this much less log det L than the one that was found.
_LARGEST_LOSS = 1e-4
# Digits of the final set and gain, relative to their own extents, and step of the final multipliers.
_DIGITS, _STEP = 7, 0.01
# Final multipliers are taken if they add this much to log det L.
_PREFERENCE = 1e-6
# Weight of every barrier next to log det L: what they cost of that is this times the number of rows of the conditions.
_BARRIER = 1e-6
# The weight falls from 1 in this many stages, each begun where the last one ended.
_STAGES = 13
# Tightenings of the conditions at which a solver looks for a point inside them.
_INNER_SLACKS = (1e-2, 1e-3, 1e-4, 1e-5, 3e-6)
_NEWTON_STEPS, _SHORTEST_STEP = 200, 1e-12
# Below this squared Newton decrement, relative to the barrier, a few whole steps are taken, and no others.
_QUADRATIC, _LAST_STEPS = 1e-4, 5

# Matrices that must be positive definite, as a function of the unknowns that is affine.
Conditions = Callable[[np.ndarray], list[np.ndarray]]


def in_round_numbers(problem: DesignProblem, found: CandidateDesign, slack: float) -> CandidateDesign | None:
    """Returns a design of nearly the volume of the one that was found, in round numbers; None where none is feasible.

    Args:
        problem: The scaled design problem.
        found: The design of a search.
        slack: Relative tightening of the conditions.
    """
    for coarse in _coarse_designs(found):
        design = _with_largest_set_and_gain(problem, coarse, slack)
        design = design and _with_largest_set_and_gain(problem, design, slack)
        if design is None or design.log_det < found.log_det - _LARGEST_LOSS:
            continue
        tuned, _ = best_multipliers(problem, problem.error_shapes, design.L, design.K, design.multipliers)
        shares = best_input_multipliers(problem.error_shapes, design.L, design.K)
        inputs = np.clip(np.round(shares, 3), 1e-3, 1.0 - 1e-3)
        again = replace(design, multipliers=_in_proportion(tuned, _STEP), inputs=inputs)
        again = _with_largest_set_and_gain(problem, again, slack)
        if again is not None and again.log_det > design.log_det + _PREFERENCE:
            design = again
        return with_best_multipliers(problem, design, problem.error_shapes)
    return None


def _coarse_designs(found: CandidateDesign) -> Iterator[CandidateDesign]:
    """Yields designs near one that was found, in few digits first; where the box is full, nearly any multipliers do."""
    if -found.log_det < VOLUME_TOLERANCE:
        inputs = np.full(len(found.inputs), _FULL_BOX_INPUTS)
        for multipliers in _FULL_BOX_MULTIPLIERS:
            yield replace(found, L=np.eye(len(found.L)), multipliers=multiplier_triple(*multipliers), inputs=inputs)
    for digits, step in zip(_SEARCHED_DIGITS, _SEARCHED_STEPS, strict=True):
        inputs = np.clip(np.round(found.inputs, digits), 10.0**-digits, 1.0 - 10.0**-digits)
        multipliers = _in_proportion(found.multipliers, step)
        yield replace(found, L=_rounded_shape(found.L, digits), multipliers=multipliers, inputs=inputs)


def _rounded_shape(shape: np.ndarray, digits: int) -> np.ndarray:
    """Returns a shape of which the factors have few digits: shape = U diag(h^2) U', U with a diagonal of 1.

    Rounded like that, a shape stays close to itself in its own units, however thin it is.
    """
    root = np.linalg.cholesky(shape)
    factor = np.round(root / np.diag(root), digits) * [float(exact.rounded(size, digits + 1)) for size in np.diag(root)]
    return exact.product(factor, factor.T)


def _rounded_gain(K: np.ndarray) -> np.ndarray:
    """Returns a gain with few digits of each input's largest answer."""
    units = 10.0 ** np.ceil(np.log10(np.maximum(np.abs(K).max(axis=1, keepdims=True), 1e-9)))
    return np.round(K / units, _DIGITS) * units


def _in_proportion(multipliers: tuple[float, float, float], step: float) -> tuple[float, float, float]:
    """Returns multipliers of sum 1, the logarithms of whose ratios are whole numbers of steps."""
    weights = np.exp(step * np.round(np.log(np.array(multipliers) / multipliers[2]) / step))
    lx, le, ld = (weights / weights.sum()).tolist()
    return lx, le, ld


def _with_largest_set_and_gain(problem: DesignProblem, design: CandidateDesign, slack: float) -> CandidateDesign | None:
    """Returns a design with the L and K of largest volume for its multipliers, X being linearized at its L; rounded.

    The conditions are those of `InvariantSetProgram`, in the unknowns (L, F, S, T_j).

    Args:
        problem: The scaled design problem.
        design: Gives the multipliers and the L.
        slack: Relative tightening of the conditions.
    """
    n, m, (lx, le, ld) = problem.n, problem.m, design.multipliers
    A, B, C, D_u = problem.A, problem.B, problem.C, (1.0 + slack) * problem.D_u
    factors = np.linalg.cholesky((1.0 + slack) * problem.maximal_error_shapes)
    squares, wide, limit = _Symmetric(n), _Symmetric(m), 1.0 - slack - 2.0 * float(ACTION_ROUNDING)
    places = np.cumsum([squares.size, m * n, wide.size] + [wide.size] * len(factors))
    halves = [np.linalg.solve(G, design.L @ G) for G in factors]

    def linearized(L: np.ndarray, G: np.ndarray, half: np.ndarray) -> np.ndarray:
        X = G.T @ L @ np.linalg.solve(G.T, half)
        return le * (X + X.T - half.T @ half)

    def conditions(x: np.ndarray) -> list[np.ndarray]:
        of_L, of_F, *of_squares = np.split(x, places[:-1])
        L, F, (S, *bounds) = squares.matrix(of_L), of_F.reshape(m, n), map(wide.matrix, of_squares)
        cross = A @ F.T @ B.T
        kept = L - D_u / ld - (A @ L @ A.T + cross + cross.T + B @ S @ B.T) / (lx * (1.0 - slack))
        rows = 1.0 - slack - ((C @ L) * C).sum(axis=1)
        found = [L, *rows.reshape(-1, 1, 1), np.block([[S, F], [F.T, L]])]
        for G, half, T in zip(factors, halves, bounds, strict=True):
            reached = np.diag(S) / design.inputs + le * np.diag(T) / (1.0 - design.inputs)
            found += [np.block([[T, F @ G], [(F @ G).T, linearized(L, G, half)]]), kept - B @ T @ B.T]
            found += list((limit - reached).reshape(-1, 1, 1))
        return found

    for tighter in _INNER_SLACKS:
        inner = InvariantSetProgram(problem, tighter).solve(design.multipliers, design.inputs, design.L)
        if inner is None:
            continue
        F, room = inner.K @ inner.L, 1e-3 * tighter * np.eye(m)
        bounds = [
            F @ G @ np.linalg.solve(linearized(inner.L, G, half), (F @ G).T) + room
            for G, half in zip(factors, halves, strict=True)
        ]
        parts = [squares.entries(inner.L), F.ravel(), *map(wide.entries, [inner.K @ F.T + room, *bounds])]
        x = _barrier_minimum(conditions, np.concatenate(parts))
        if x is not None:
            of_L, of_F = np.split(x, places[:2])[:2]
            L = squares.matrix(of_L)
            K = _rounded_gain(np.linalg.solve(L, of_F.reshape(m, n).T).T)
            log_det = float(np.linalg.slogdet(L)[1])
            return replace(design, L=_rounded_shape(L, _DIGITS), K=K, log_det=log_det)
    return None


class _Symmetric:
    """Symmetric matrices of one size as vectors of the entries on and above the diagonal."""

    def __init__(self, size: int) -> None:
        self._upper, self._shape = np.triu_indices(size), (size, size)
        self.size = len(self._upper[0])

    def entries(self, matrix: np.ndarray) -> np.ndarray:
        return matrix[self._upper]

    def matrix(self, entries: np.ndarray) -> np.ndarray:
        matrix = np.zeros(self._shape)
        matrix[self._upper] = entries
        return matrix + np.triu(matrix, 1).T


def _barrier_minimum(conditions: Conditions, start: np.ndarray) -> np.ndarray | None:
    """Returns the x, shape (d,), that maximizes log det of the first matrix plus the barriers of all others.

    Args:
        conditions: Gives the matrices, together bounded enough for a unique maximum.
        start: Where all of them are positive definite, shape (d,); None is returned elsewhere.
    """
    constants = conditions(np.zeros(len(start)))
    units = [conditions(unit) for unit in np.eye(len(start))]
    slopes = [np.stack([unit[k] - constant for unit in units]) for k, constant in enumerate(constants)]
    x: np.ndarray | None = start
    for barrier in np.geomspace(1.0, _BARRIER, _STAGES):
        weights = [1.0] + [float(barrier)] * (len(constants) - 1)
        x = None if x is None else _newton(conditions, slopes, weights, x)
    return x


def _newton(
    conditions: Conditions, slopes: list[np.ndarray], weights: list[float], start: np.ndarray
) -> np.ndarray | None:
    """Returns the x that maximizes the sum of weight log det, by Newton's method; None where it cannot begin.

    Args:
        conditions: Gives the matrices, (s, s) each.
        slopes: Their derivatives, shape (d, s, s) each.
        weights: Their weights.
        start: Where all of them are positive definite, shape (d,).
    """

    def value(x: np.ndarray) -> float:
        try:
            roots = [np.linalg.cholesky(matrix) for matrix in conditions(x)]
        except np.linalg.LinAlgError:
            return np.inf
        logarithms = [float(np.log(np.diag(root)).sum()) for root in roots]
        return -2.0 * sum(weight * each for weight, each in zip(weights, logarithms, strict=True))

    x, reached, close = start, value(start), 0
    if not np.isfinite(reached):
        return None
    for _ in range(_NEWTON_STEPS):
        gradient, hessian = np.zeros(len(x)), np.zeros((len(x), len(x)))
        for weight, matrix, slope in zip(weights, conditions(x), slopes, strict=True):
            relative = np.linalg.solve(matrix, slope)
            gradient -= weight * np.trace(relative, axis1=1, axis2=2)
            hessian += weight * relative.reshape(len(x), -1) @ relative.transpose(0, 2, 1).reshape(len(x), -1).T
        # In units in which the diagonal is 1: a gain that hardly matters has as many digits as one that does.
        scale = 1.0 / np.sqrt(np.diag(hessian))
        try:
            step = -scale * np.linalg.solve(hessian * np.outer(scale, scale), scale * gradient)
        except np.linalg.LinAlgError:
            return None
        decrement = float(-gradient @ step)
        if not np.isfinite(decrement):
            return None
        if decrement < _QUADRATIC * weights[-1]:  # too little for the value to show, but each step doubles the digits
            x, close = x + step, close + 1
            if close == _LAST_STEPS:
                return x
            continue
        length = 1.0
        while length > _SHORTEST_STEP and not value(x + length * step) < reached:
            length *= 0.5
        if length <= _SHORTEST_STEP:
            return x
        x = x + length * step
        reached = value(x)
    return x
