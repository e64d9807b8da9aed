"""How far a certified plan can be moved towards other plans: in closed form, since certified plans form a convex set."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from shields.lookahead.plan_test import PlanTest
from shields.lookahead.tightening import Tightening

# A move ends this fraction before what the test allows, so that rounded inputs pass as well.
SHORTENED = 1e-4
# Angles between the way to the proposed input and the ways past what is in between.
ANGLES = (-1.2, -0.8, -0.4, 0.4, 0.8, 1.2)


@np.errstate(all="ignore")  # where nothing is known nothing is moved
def moved(
    test: PlanTest, estimates: np.ndarray, tightening: Tightening, plans: np.ndarray, targets: np.ndarray
) -> np.ndarray:
    """Returns what the plan test allows between plans and others, as close to the others as possible.

    On the way every |c_i c_j| is the absolute value of a linear function and |T G c_j|^2 is quadratic, so that where
    the way enters and leaves what is allowed is known; for each length the rows before it and its own end count.
    Neither end of the way needs to be certified.

    Args:
        test: The plan test.
        estimates: x_hat, shape (E, n).
        tightening: Of the error shapes of each.
        plans: Shape (E, Q, N, m).
        targets: Shape (E, Q, N, m).

    Returns:
        Shape (E, Q, N, m); neither rounded nor tested. Where nothing is allowed, the plans themselves.
    """
    box, radius = (part.transpose(*range(1, part.ndim), 0)[..., None] for part in test.room(estimates, tightening))
    start, turned = test.judged(estimates, tightening, plans)
    way, turning = (end - begin for end, begin in zip(
        test.judged(estimates, tightening, targets), (start, turned), strict=True))
    middle, half = -start / way, box / np.abs(way)
    still = way == 0.0
    outside = np.where(np.abs(start) <= box, -np.inf, np.inf)
    low, high = np.where(still, outside, middle - half).max(axis=1), np.where(still, -outside, middle + half).min(axis=1)
    a, b = (turning * turning).sum(axis=1), (turning * turned).sum(axis=1)
    root = np.sqrt(b * b - a * ((turned * turned).sum(axis=1) - radius * radius))
    first, last = (-b - root) / a, (root - b) / a
    first[1:] = np.maximum(first[1:], np.maximum.accumulate(low[:-1], axis=0))
    last[1:] = np.minimum(last[1:], np.minimum.accumulate(high[:-1], axis=0))
    first, last = np.maximum(first, 0.0), np.minimum(last, 1.0)
    possible = (first <= last) & (radius > 0.0)
    fraction = np.where(possible, last - SHORTENED * (last - first), 0.0).max(axis=0)
    return plans + fraction[..., None, None] * (targets - plans)


def waypoints(first: np.ndarray, proposed: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Returns first inputs, shape (E, W, m), closer to the proposed ones than `first` is, in directions around theirs.

    Of each direction the point that is closest to the proposed input; with a single input there is no other direction.

    Args:
        first: First inputs of plans, shape (E, m).
        proposed: Shape (E, m).
        limits: Shape (m,).
    """
    way, points = proposed - first, []
    for i, k in combinations(range(len(limits)), 2):
        for angle in ANGLES:
            cosine, sine = np.cos(angle), np.sin(angle)
            step = way.copy()
            step[:, i] = cosine * (cosine * way[:, i] - sine * way[:, k])
            step[:, k] = cosine * (sine * way[:, i] + cosine * way[:, k])
            points.append(np.minimum(np.maximum(first + step, -limits), limits))
    return np.stack(points, axis=1) if points else np.empty((len(first), 0, len(limits)))
