"""The closest admissible input: projection onto the intersection of a box and an ellipsoid test."""

from __future__ import annotations

import numpy as np

# A gain below this share of the largest counts as a direction that does not move the state.
FLAT = 1e-13
# Newton steps on the multiplier; from the left on a concave function they rise monotonically and converge fast.
NEWTON_STEPS = 60
RELATIVE_TOLERANCE = 1e-12


def closest_on_line(wanted: float, a: float, b: float, c: float, radius: float, limit: float) -> float | None:
    """Returns argmin |u - wanted| over c + 2 b u + a u^2 <= radius^2, |u| <= limit, or None; |wanted| <= limit."""
    square = b * b - a * (c - radius * radius)
    if radius < 0.0 or square < 0.0:
        return None
    if a <= 0.0:
        return wanted if c <= radius * radius else None
    half = square**0.5
    low, high = (-b - half) / a, (-b + half) / a
    if low > limit or high < -limit:
        return None
    return low if wanted < low else high if wanted > high else wanted


def closest_admissible(
    wanted: np.ndarray, offset: np.ndarray, effect: np.ndarray, radius: float, limit: np.ndarray
) -> np.ndarray | None:
    """Returns argmin |u - wanted| over |offset + effect u| <= radius, |u_i| <= limit_i; None if there is none.

    By branching on input limits: if the solution without the limits breaks some of them, then at the true solution
    at least one of those is attained (otherwise a small move towards the former would stay feasible and be closer).

    Args:
        wanted: Shape (m,).
        offset: Shape (n,).
        effect: Shape (n, m).
        radius: Of the ball; none is admissible if it is negative.
        limit: Shape (m,), > 0.
    """
    if radius < 0.0:
        return None
    best: tuple[float, np.ndarray | None] = (np.inf, None)
    pending: list[dict[int, float]] = [{}]
    seen: set[frozenset[tuple[int, float]]] = set()
    while pending:
        fixed = pending.pop()
        candidate = _with_fixed(wanted, offset, effect, radius, fixed)
        if candidate is None:
            continue
        distance = float(np.linalg.norm(candidate - wanted))
        if distance >= best[0]:
            continue
        broken = [i for i in range(len(wanted)) if i not in fixed and abs(candidate[i]) > limit[i]]
        if not broken:
            best = (distance, candidate)
        for i in broken:
            branch = {**fixed, i: float(np.copysign(limit[i], candidate[i]))}
            if (key := frozenset(branch.items())) not in seen:
                seen.add(key)
                pending.append(branch)
    return best[1]


def _with_fixed(
    wanted: np.ndarray, offset: np.ndarray, effect: np.ndarray, radius: float, fixed: dict[int, float]
) -> np.ndarray | None:
    """Returns the closest input in the ball test alone, with some entries held; None if the test cannot be met."""
    solution = wanted.copy()
    for i, value in fixed.items():
        solution[i] = value
    free = [i for i in range(len(wanted)) if i not in fixed]
    held = list(fixed)
    moved = offset + effect[:, held] @ solution[held]
    if np.linalg.norm(moved + effect[:, free] @ solution[free]) <= radius:
        return solution
    if not free:
        return None
    closest = _onto_ball(solution[free], moved, effect[:, free], radius)
    if closest is None:
        return None
    solution[free] = closest
    return solution


def _onto_ball(wanted: np.ndarray, offset: np.ndarray, effect: np.ndarray, radius: float) -> np.ndarray | None:
    """Returns argmin |u - wanted| on |offset + effect u| = radius, for a `wanted` outside; None if out of reach.

    With effect = U diag(r) V' and s = r^2 the minimizer for multiplier t is c_i + (w_i - c_i) / (1 + t s_i) in the axes
    V, c the center of the test; 1 / sqrt(excess) is concave and increasing in t (as in trust-region methods).
    """
    images, gains, axes = np.linalg.svd(effect, full_matrices=False)
    moves = gains > FLAT * max(float(gains[0]), 0.0)
    images, gains, axes = images[:, moves], gains[moves], axes[moves].T
    seen = images.T @ offset
    center = -seen / gains
    away = axes.T @ wanted - center
    residual = offset - images @ seen
    reach = radius**2 - float(residual @ residual)
    s = gains**2
    if reach < 0.0 or not moves.any():
        return None
    multiplier = 0.0
    for _ in range(NEWTON_STEPS):
        share = 1.0 / (1.0 + multiplier * s)
        excess = float((s * (away * share) ** 2).sum())
        if excess <= reach * (1.0 + RELATIVE_TOLERANCE):
            break
        slope = float((s**2 * away**2 * share**3).sum())
        multiplier += excess / slope * (np.sqrt(excess / reach) - 1.0) if reach > 0.0 else 1e300
    moved = axes @ (away / (1.0 + multiplier * s) - away)
    return wanted + moved
