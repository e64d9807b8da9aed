"""The closest admissible inputs: projection onto the intersection of a box and an ellipsoid, for many at once."""

from __future__ import annotations

from math import inf, isinf, nan, sqrt
from typing import Any

import numpy as np

# A gain below this fraction of the largest counts as a direction that does not move the state.
FLAT = 1e-13
# Rows whose directions differ by less than this are parallel; what is found is tested again, with a larger margin.
PARALLEL = 1e-12
# Where the way to a set is longer than one over this, next to the way to the farthest of its faces, there is none.
NOTHING_LEFT = 1e-9
# Newton steps on the multiplier; from the left on a concave function they rise monotonically and converge fast.
NEWTON_STEPS = 60
RELATIVE_TOLERANCE = 1e-12


def closest_admissible(
    wanted: np.ndarray, offset: np.ndarray, effect: np.ndarray, radius: np.ndarray, limit: np.ndarray
) -> np.ndarray:
    """Returns argmin |u - wanted| over |offset + effect u| <= radius, |u_i| <= limit_i; NaN where there is none.

    One input is an interval. Otherwise by branching on input limits: if the solution without the limits breaks some of
    them, then at the true solution at least one of those is attained (otherwise a small move towards the former would
    stay feasible and be closer). A candidate is a problem and the limits it holds; one that is farther away than a
    solution found is not branched on.

    Args:
        wanted: Shape (m, N), within the limits.
        offset: Shape (n, N).
        effect: Shape (n, m, N).
        radius: Of the ball, shape (N,); nothing is admissible if it is negative or NaN.
        limit: Shape (m,), > 0.

    Returns:
        Shape (m, N).
    """
    if len(wanted) == 1:
        effect = effect[:, 0]
        form = (effect * effect).sum(axis=0), (effect * offset).sum(axis=0), (offset * offset).sum(axis=0)
        return closest_on_lines(wanted, *form, radius, limit[0])
    closest, distance = np.full(wanted.shape, np.nan), np.full(len(radius), np.inf)
    problem = np.flatnonzero(radius >= 0.0)
    held = np.zeros((len(wanted), len(problem)))  # the sign of the limit at which an input is held, 0 if it is free
    while problem.size:  # every turn holds one limit more
        start = np.where(held == 0.0, wanted[:, problem], held * limit[:, None])
        u = _onto_balls(start, offset[:, problem], effect[:, :, problem], radius[problem], held == 0.0)
        away = np.sqrt(((u - wanted[:, problem]) ** 2).sum(axis=0))
        beyond = (np.abs(u) > limit[:, None]) & (held == 0.0)
        solved = np.flatnonzero((away < distance[problem]) & ~beyond.any(axis=0))
        np.minimum.at(distance, problem[solved], away[solved])
        best = solved[away[solved] == distance[problem[solved]]]
        closest[:, problem[best]] = u[:, best]
        problem, held = _branched(problem, held, np.sign(u), beyond & (away < distance[problem]))
    return closest


def _branched(
    problem: np.ndarray, held: np.ndarray, signs: np.ndarray, broken: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the candidates that hold one more of the limits broken, at the sign it is broken with.

    Each comes once; of two inputs perhaps twice, which costs less than to look for it.
    """
    which, parent = np.nonzero(broken)
    if not parent.size:
        return parent, held[:, parent]
    branches = held[:, parent]
    branches[which, np.arange(len(parent))] = signs[which, parent]
    if len(held) == 2:
        return problem[parent], branches
    candidates = np.unique(np.vstack([problem[parent], branches]), axis=1)
    return candidates[0].astype(np.int64), candidates[1:]


def closest_on_lines(wanted: Any, a: Any, b: Any, c: Any, radius: Any, limit: Any) -> Any:
    """Returns argmin |u - wanted| over a u^2 + 2 b u + c <= radius^2, |u| <= limit; NaN where there is none.

    Numbers or arrays of them; |wanted| <= limit.
    """
    excess = c - radius * radius
    half = np.sqrt(b * b - a * excess)
    low, high = (-b - half) / a, (-b + half) / a
    closest = np.minimum(np.maximum(wanted, low), high)
    found = (radius >= 0.0) & (low <= limit) & (high >= -limit)
    if np.count_nonzero(a) < np.size(a):  # an input that moves nothing
        found = np.where(a > 0.0, found, (radius >= 0.0) & (excess <= 0.0))
        closest = np.where(a > 0.0, closest, wanted)
    return np.where(found, closest, np.nan)


def closest_on_line(wanted: float, a: float, b: float, c: float, radius: float, limit: float) -> float:
    """Returns what `closest_on_lines` does for Python numbers and a >= 0: a shielded step takes 4 to 7 % less."""
    excess = c - radius * radius
    discriminant = b * b - a * excess
    if a > 0.0 and radius >= 0.0 and discriminant >= 0.0:
        half = sqrt(discriminant)
        low, high = (-b - half) / a, (-b + half) / a
        return min(max(wanted, low), high) if low <= limit and high >= -limit else nan
    return wanted if a == 0.0 and radius >= 0.0 and excess <= 0.0 else nan


def closest_in_interval(wanted: float, offset: list[float], effect: list[float], limits: list[float]) -> float:
    """Returns what `closest_between` does for Python numbers and one input, in a sixth of the time: lists of r rows."""
    lowest, highest = -inf, inf
    for away, gain, limit in zip(offset, effect, limits, strict=True):
        inverse, low, high = 1.0 / gain if gain else inf, -inf, inf
        if not isinf(inverse):
            middle, half = away * -inverse, limit * abs(inverse)
            low, high = middle - half, middle + half
        elif not abs(away) <= limit:  # a row that no input moves
            return nan
        if not low <= high:  # neither NaN
            return nan
        lowest, highest = max(lowest, low), min(highest, high)
    return min(max(wanted, lowest), highest) if lowest <= highest else nan


def _onto_balls(
    start: np.ndarray, offset: np.ndarray, effect: np.ndarray, radius: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """Returns argmin |u - start| over |offset + effect u| <= radius, moving free inputs only; NaN where there is none.

    With effect = U diag(r) V' and s = r^2 the minimizer for multiplier t is c_i + (w_i - c_i) / (1 + t s_i) in the axes
    V, c the center of the test; 1 / sqrt(excess) is concave and increasing in t (as in trust-region methods).

    Shapes are those of `closest_admissible` for F problems.
    """
    reached = offset + (effect * start).sum(axis=1)
    images, axes = _orthogonal_images(effect * free)
    s = (images * images).sum(axis=0)
    s = np.where(s > FLAT**2 * s.max(axis=0), s, 0.0)
    # From here in the axes: how far the start is from the center, and what no input can change of the distance.
    away = np.where(s > 0.0, (images * reached[:, None]).sum(axis=0) / s, 0.0)
    rest = reached - (images * away).sum(axis=1)
    reach = radius * radius - (rest * rest).sum(axis=0)
    multiplier = _multipliers(s, away, reach)
    move = away / (1.0 + multiplier * s) - away
    solution = np.where(free, start + (axes * move).sum(axis=1), start)
    solution = np.where((reach >= 0.0) & (s > 0.0).any(axis=0), solution, np.nan)
    return np.where((reached * reached).sum(axis=0) <= radius * radius, start, solution)


def _multipliers(s: np.ndarray, away: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Returns t >= 0, shape (F,), with sum_i s_i (away_i / (1 + t s_i))^2 <= reach, by Newton's method."""
    multiplier = np.zeros(len(reach))
    for _ in range(NEWTON_STEPS):
        shrunk = 1.0 / (1.0 + multiplier * s)
        parts = s * (away * shrunk) ** 2
        excess = parts.sum(axis=0)
        unmet = excess > reach * (1.0 + RELATIVE_TOLERANCE)
        if not (unmet & (reach >= 0.0)).any():
            break
        growth = excess / (s * parts * shrunk).sum(axis=0) * (np.sqrt(excess / reach) - 1.0)
        multiplier = np.where(unmet, multiplier + np.minimum(growth, 1e300), multiplier)
    return multiplier


def _orthogonal_images(effect: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns effect V with orthogonal columns, shape (n, k, F), and V with orthonormal ones, shape (m, k, F).

    V leaves out only directions that move nothing. Two inputs need one rotation in closed form; the singular value
    decomposition of more takes a hundred times as long.
    """
    if effect.shape[1] > 2:
        images, gains, axes = np.linalg.svd(effect.transpose(2, 0, 1), full_matrices=False)
        return (images * gains[:, None]).transpose(1, 2, 0), axes.transpose(2, 1, 0)
    first, second = effect[:, 0], effect[:, 1]
    a, b, d = (first * first).sum(axis=0), (first * second).sum(axis=0), (second * second).sum(axis=0)
    twist = (d - a) / (2.0 * b)
    tangent = np.where(b == 0.0, 0.0, np.copysign(1.0, twist) / (np.abs(twist) + np.sqrt(1.0 + twist * twist)))
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    images = np.stack([cosine * first - sine * second, sine * first + cosine * second], axis=1)
    return images, np.array([[cosine, sine], [-sine, cosine]])


def closest_between(wanted: np.ndarray, offset: np.ndarray, effect: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Returns argmin |u - wanted| over |offset + effect u| <= limits, row by row; NaN where there is none.

    Args:
        wanted: Shape (m, N).
        offset: Shape (r, N).
        effect: Shape (r, m); every direction has some row.
        limits: Shape (r, N); nothing is admissible where one is negative or NaN.

    Returns:
        Shape (m, N).
    """
    if len(wanted) == 1:
        return _closest_in_interval(wanted, offset, effect, limits)
    values = offset + effect @ wanted
    beyond = ~(np.abs(values) <= limits)
    closest = np.where(beyond.any(axis=0), np.nan, wanted)
    beyond = beyond & (limits >= 0.0).all(axis=0)
    if len(wanted) == 2:
        return _closest_on_edges(closest, wanted, values, effect, limits, beyond)
    for each in np.flatnonzero(beyond.any(axis=0)):
        closest[:, each] = wanted[:, each] + _shortest(effect, values[:, each], limits[:, each])
    return closest


def _closest_in_interval(wanted: np.ndarray, offset: np.ndarray, effect: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Returns what `closest_between` does for one input, whose effect may differ between problems, shape (r, N)."""
    inverse = 1.0 / effect
    flat = np.isinf(inverse)
    middle, half = offset * -inverse, limits * np.abs(inverse)
    low, high = middle - half, middle + half
    if np.count_nonzero(flat):  # rows that no input moves
        low = np.where(flat, np.where(np.abs(offset) <= limits, -np.inf, np.inf), low)
        high = np.where(flat, np.inf, high)
    low, high = low.max(axis=0), high.min(axis=0)
    return np.where(low <= high, np.minimum(np.maximum(wanted, low), high), np.nan)


def _closest_on_edges(
    closest: np.ndarray,
    wanted: np.ndarray,
    values: np.ndarray,
    effect: np.ndarray,
    limits: np.ndarray,
    beyond: np.ndarray,
) -> np.ndarray:
    """Returns `closest`, shape (2, N), with what `closest_between` finds of two inputs.

    Nothing is closer than the edge that the wanted point is farthest beyond: if the foot on it is admissible, it is the
    closest. Else the closest lies on some edge that the wanted point is beyond, in an interval of its line. `values`
    are those of the rows at the wanted inputs, `beyond` says which problems are beyond which edges.
    """
    squares = (effect * effect).sum(axis=1)
    beyond = beyond & (squares > 0.0)[:, None]

    def feet(row: np.ndarray, problem: np.ndarray) -> np.ndarray:
        """Returns the shortest moves onto edges of problems, shape (2, k)."""
        way = np.sign(values[row, problem]) * limits[row, problem] - values[row, problem]
        return effect[row].T * (way / squares[row])

    problem = np.flatnonzero(beyond.any(axis=0))
    distance = (np.abs(values[:, problem]) - limits[:, problem]) / np.sqrt(squares)[:, None]
    row = np.where(beyond[:, problem], distance, -np.inf).argmax(axis=0)
    foot = feet(row, problem)
    kept = np.abs(values[:, problem] + effect @ foot) <= limits[:, problem]
    kept[row, np.arange(len(row))] = True  # the edge itself
    found = kept.all(axis=0)
    closest[:, problem[found]] = (wanted[:, problem] + foot)[:, found]
    beyond[:, problem[found]] = False

    row, problem = np.nonzero(beyond)
    foot = feet(row, problem)
    line = np.stack([-effect[row, 1], effect[row, 0]]) / np.sqrt(squares[row])
    left, along = limits[:, problem], effect @ line
    left[row, np.arange(len(row))] = np.inf
    # A row that is parallel to the edge does not change on its line: rounding must not decide whether it holds there.
    parallel = along * along <= PARALLEL**2 * squares[:, None]
    along = np.where(parallel, 0.0, along)
    left = np.where(parallel, left * (1.0 + PARALLEL) + PARALLEL * np.abs(values[:, problem]), left)
    start = values[:, problem] + effect @ foot
    moves = foot + line * _closest_in_interval(np.zeros((1, len(row))), start, along, left)
    distance = np.hypot(*moves)
    least = np.full(wanted.shape[1], np.inf)
    np.fmin.at(least, problem, distance)
    best = distance == least[problem]
    closest[:, problem[best]] = (wanted[:, problem] + moves)[:, best]
    return closest


def _shortest(effect: np.ndarray, values: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Returns argmin |x| over |values + effect x| <= limits, shape (m,); NaN where there is none.

    For rows G x >= h that is a problem of least distance: with z >= 0 of the smallest r = (G' z, h' z - 1),
    x = -r[:m] / r[m] (Lawson and Hanson 1974, chapter 23, docs/bibliography.md). Effect is (r, m), values and
    limits (r,); x = 0 does not fulfil all rows.
    """
    from scipy.optimize import nnls  # takes long to import

    none, sizes = np.full(effect.shape[1], np.nan), np.sqrt((effect * effect).sum(axis=1))
    moved = sizes > 0.0
    if not (np.abs(values[~moved]) <= limits[~moved]).all():
        return none
    G = effect[moved] / sizes[moved, None]
    G, h = np.concatenate([-G, G]), np.concatenate([values - limits, -values - limits])[np.tile(moved, 2)]
    h = h / np.tile(sizes[moved], 2)
    farthest = float(h.max())
    try:
        z, left = nnls(np.vstack([G.T, h / farthest]), np.eye(len(none) + 1)[-1])
    except (RuntimeError, ValueError):  # no solution within its steps, or what is not finite
        return none
    return (G.T @ z) * (farthest / (1.0 - float(h @ z) / farthest)) if left > NOTHING_LEFT else none
