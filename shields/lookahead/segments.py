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
    """Returns certified plans moved towards others until the test of the best length allows no more.

    On the way every |c_i c_j| is the absolute value of a linear function and |T G c_j|^2 is quadratic, so that the end
    of the way is known; for each length the rows before it and its own end count.

    Args:
        test: The plan test.
        estimates: x_hat, shape (E, n).
        tightening: Of the error shapes of each.
        plans: Shape (E, N, m).
        targets: Shape (E, Q, N, m).

    Returns:
        Shape (E, Q, N, m); neither rounded nor tested.
    """
    box, radius = test.room(estimates, tightening)
    both = test.prediction.centers(estimates, np.concatenate([plans[:, None], targets], axis=1))
    start, way = both[:, :1], both[:, 1:] - both[:, :1]
    rows = test.prediction.plant.C.T
    values, changes = start @ rows, way @ rows
    room = box[:, None] - np.copysign(1.0, changes) * values
    allowed = np.where(changes != 0.0, room / np.abs(changes), np.inf).min(axis=-1)
    allowed = np.minimum.accumulate(allowed, axis=-1)
    before = np.concatenate([np.full_like(allowed[..., :1], np.inf), allowed[..., :-1]], axis=-1)
    turn = tightening.turn[:, None]
    values, changes = (turn @ start[..., None])[..., 0], (turn @ way[..., None])[..., 0]
    a, b = (changes * changes).sum(axis=-1), (changes * values).sum(axis=-1)
    missing = (values * values).sum(axis=-1) - np.square(radius)[:, None]
    ends = np.where((missing <= 0.0) & (radius > 0.0)[:, None], (np.sqrt(b * b - a * missing) - b) / a, -1.0)
    fraction = np.nan_to_num(np.minimum(before, ends), nan=0.0).max(axis=-1)
    fraction = (1.0 - SHORTENED) * np.minimum(np.maximum(fraction, 0.0), 1.0)
    return plans[:, None] + fraction[..., None, None] * (targets - plans[:, None])


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
