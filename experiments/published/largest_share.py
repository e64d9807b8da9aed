"""The share of a safe box that a controller could keep at most: one that knows the state, undisturbed."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from ncs_gym import LinearPlant
from shields.synthesis.invariant_polytope import points_of_box

# From so many points, a power of two, inputs are sought that keep the limits for so many steps.
_POINTS_LOG2, _STEPS = 9, 60


def largest_share(plant: LinearPlant) -> float | None:
    """Returns the share of the safe box from which some sequence of inputs keeps the limits of a plant for 60 steps.

    Without disturbance, errors and limits of states and inputs together: no invariant set has a larger share. It is
    counted at 512 points, to about .02. None where the box is no product of intervals.
    """
    points = points_of_box(plant, _POINTS_LOG2)
    if points is None:
        return None
    n = plant.n
    # Of u_0, ..., u_(N-1), x_1, ..., x_N: x_(k+1) - A x_k - B u_k is A x_0 in the first step and 0 in the others.
    pushed = sparse.kron(sparse.eye(_STEPS), -plant.B)
    moved = sparse.eye(n * _STEPS) - sparse.kron(sparse.eye(_STEPS, k=-1), plant.A)
    model = sparse.hstack([pushed, moved]).tocsr()
    row = np.abs(plant.box).argmax(axis=0)  # of each state
    states = np.sort(plant.box_ends[:, row] / plant.box.sum(axis=0), axis=0)
    inputs = np.stack([plant.input_low, plant.input_high])
    ends = np.concatenate([np.tile(inputs, _STEPS), np.tile(states, _STEPS)], axis=1).T
    first = np.zeros(n * _STEPS)
    kept = 0
    for point in points:
        first[:n] = plant.A @ point
        found = linprog(np.zeros(len(ends)), A_eq=model, b_eq=first, bounds=ends, method="highs")
        kept += found.status == 0
    return kept / len(points)
