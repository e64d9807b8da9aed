"""Plans that cost no solver: a given beginning, and then a gain at the predicted centers, limited or saturated."""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from ncs_gym import LinearPlant

# Weight of inputs, in units of their limits, against states, in units of the box, in the regulator that brakes, and in
# the one whose prediction knows no limits: it has to keep them by itself.
INPUT_WEIGHT, UNLIMITED_INPUT_WEIGHT = 1e-2, 1.0


def regulator(plant: LinearPlant, input_weight: float = INPUT_WEIGHT) -> np.ndarray | None:
    """Returns the gain, shape (m, n), of a linear-quadratic regulator; None if there is none."""
    R = input_weight * np.diag(plant.u_max**-2.0)
    try:
        P = solve_discrete_are(plant.A, plant.B, plant.weight, R)
        gain = -np.linalg.solve(R + plant.B.T @ P @ plant.B, plant.B.T @ P @ plant.A)
    except (LinAlgError, ValueError):
        return None
    return gain if np.isfinite(gain).all() else None


def expressible(inputs: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Returns the nearest u_max * float32 actions; the last axis is the input's."""
    return limits * np.minimum(np.maximum(inputs / limits, -1.0), 1.0).astype(np.float32)


def closed_loop(plant: LinearPlant, gain: np.ndarray, steps: int) -> np.ndarray:
    """Returns the matrix, shape (n + m, steps m), that takes a row (x_hat, u_0) to u_0, u_1 = gain c_1, gain c_2, ...

    The centers are those of the inputs without limits.
    """
    center, inputs = np.hstack([plant.A, plant.B]), [np.eye(plant.n + plant.m)[plant.n :]]
    for _ in range(steps - 1):
        inputs.append(gain @ center)
        center = (plant.A + plant.B @ gain) @ center
    return np.ascontiguousarray(np.concatenate(inputs).T)


@np.errstate(all="ignore")  # what is not finite passes no test
def completed(plant: LinearPlant, estimates: np.ndarray, beginnings: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Returns plans that go on with u_j = gain c_j, saturated and expressible, where a beginning is NaN.

    Args:
        plant: Gives A, B and the limits.
        estimates: x_hat, shape (E, n).
        beginnings: Inputs of P plans, shape (E, P, N, m), NaN where they are not given.
        gains: Shape (P, m, n).
    """
    number, steps = beginnings.shape[1:3]
    plans = np.ascontiguousarray(beginnings.transpose(2, 1, 0, 3))  # products with few large matrices are fast
    missing: np.ndarray = np.asarray(np.isnan(plans))
    flat = missing.reshape(steps, -1)
    some, every = np.any(flat, axis=1), np.all(flat, axis=1)
    turned, A, B = gains.swapaxes(1, 2), plant.A.T, plant.B.T
    centers = np.repeat(estimates[None], number, axis=0)
    for j in range(steps):
        u = plans[j]
        if some[j]:
            gained = np.minimum(np.maximum(centers @ turned, -plant.u_max), plant.u_max)
            u = plans[j] = gained if every[j] else np.where(missing[j], gained, u)
        if j + 1 < steps:
            centers = centers @ A + u @ B
    plans = np.where(missing, expressible(plans, plant.u_max), plans)
    return np.ascontiguousarray(plans.transpose(2, 1, 0, 3))
