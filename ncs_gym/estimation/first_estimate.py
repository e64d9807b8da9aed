"""A first estimate from samples alone, where nothing else is known of the state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ncs_gym.estimation.error_sets import ErrorSet
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.shape_matrices import outer_sum

# Room for the rounding of sums of a few dozen terms; directions that samples tell apart less are not told apart.
ROUNDING, LEAST_SHARE = 1e-9, 1e-9


def first_estimate(
    plant: LinearPlant,
    error_set: ErrorSet,
    samples: Mapping[int, np.ndarray],
    inputs: Sequence[np.ndarray],
    sensor_error: np.ndarray,
) -> tuple[np.ndarray, int] | None:
    """Returns x_hat now, shape (n,), and the age of the newest sample, if samples prove that its error is certified.

    With z the state at the oldest sample, w steps ago, every sample is y_a = H x_a + v_a, and x_a = A^(w-a) z plus what
    inputs and disturbances since then add. Weighted least squares give z, and the inputs x_hat. Its error is a sum of
    independent terms M d of every disturbance and T v of every sample, so that it lies in an ellipsoid around the sum
    of all E(M D M') and E(T N T') (docs/shield_proof.md, "Unknown start"). Where that lies inside the certified set of
    its age, the estimate is as good as one that was always followed. The fewest newest samples that prove it are taken.
    Older ones are a second opinion: what they alone say must have a state in common with it, or one of them is wrong.
    So one is where a sample is off from what all of them say by more than noise and disturbances can explain. Not every
    contradiction is found so; samples within the bounds have none.

    Args:
        plant: The plant, without a remainder: its bound would need to be known to hold for the states that are sought.
        error_set: The certified sets.
        samples: By age [steps], each of shape (p,).
        inputs: What was applied one step ago, two steps ago and so on, at least as far back as the oldest sample, (m,).
        sensor_error: N, shape (p, p).

    Returns:
        None if nothing is proved, or samples are found to contradict each other.
    """
    ages = sorted(samples)
    certified = error_set.shape_at(ages[0]) if ages and plant.remainder is None else None
    if certified is None:
        return None
    size = np.sqrt(np.diag(certified))
    for count in range(1, len(ages) + 1):
        estimate, shape = _least_squares(plant, {age: samples[age] for age in ages[:count]}, inputs, sensor_error)
        rest = (certified - (1.0 + ROUNDING) * shape) / np.outer(size, size)
        if np.isfinite(estimate).all() and np.isfinite(rest).all() and np.linalg.eigvalsh(rest)[0] > ROUNDING:
            older = [{age: samples[age] for age in ages[count:end]} for end in range(count + 1, len(ages) + 1)]
            others = [_least_squares(plant, each, inputs, sensor_error) for each in older]
            is_wrong = any(_are_apart(estimate, shape, *each) for each in others)
            is_wrong = is_wrong or _are_impossible(plant, samples, inputs, sensor_error)
            return None if is_wrong else (estimate, ages[0])
    return None


def _are_apart(x: np.ndarray, X: np.ndarray, z: np.ndarray, Z: np.ndarray) -> bool:
    """Returns whether x + E(X) and z + E(Z) have surely no point in common; of what is NaN that is not sure."""
    if not np.isfinite(Z).all():
        return False
    scale = np.sqrt(np.maximum(np.diag(X + Z), np.finfo(float).tiny))
    direction = np.linalg.lstsq((X + Z) / np.outer(scale, scale), (x - z) / scale, rcond=None)[0] / scale
    widths = np.sqrt(np.array([max(float(direction @ shape @ direction), 0.0) for shape in (X, Z)]))
    return bool(direction @ (x - z) > (1.0 + ROUNDING) * widths.sum())


def _are_impossible(
    plant: LinearPlant, samples: Mapping[int, np.ndarray], inputs: Sequence[np.ndarray], N: np.ndarray
) -> bool:
    """Returns whether samples alone show that not all of them are within the bounds.

    What their least-squares fit leaves of them does not depend on the state: in each entry, and along itself, it is at
    most the sum of what every disturbance and every noise can add (the supports of their ellipsoids).
    """
    H, D, w = plant.H, plant.disturbance.shape_matrix, max(samples)
    powers, moved = _without_disturbances(plant, inputs, w)
    measured = np.concatenate(list(samples.values()))
    given = measured - np.concatenate([H @ moved[w - age] for age in samples])
    weights = np.tile(1.0 / np.linalg.norm(H * plant.half_widths, axis=1), len(samples))
    regressors = weights[:, None] * np.vstack([H @ powers[w - age] for age in samples]) * plant.half_widths
    axes, values, _ = np.linalg.svd(regressors)
    beside = axes[:, np.count_nonzero(values > LEAST_SHARE * values[0]) :]  # what no state can do
    rows = beside @ beside.T * weights
    rows = np.vstack([rows, rows @ given @ rows])
    parts = dict(zip(samples, np.hsplit(rows, len(samples)), strict=True))
    most = ROUNDING * np.abs(rows) @ (np.abs(measured) + np.abs(given - measured))
    for part in parts.values():
        most += (1.0 + ROUNDING) * np.sqrt(((part @ N) * part).sum(axis=1))
    for left in range(w):  # steps that are left after the one in which a disturbance acted
        moves = sum((part @ H @ powers[left - age] for age, part in parts.items() if age <= left), 0.0 * rows[:, :1])
        most += (1.0 + ROUNDING) * np.sqrt(((moves @ D) * moves).sum(axis=1)) if np.any(moves) else 0.0
    return bool((rows @ given > most).any() or (-rows @ given > most).any())


def _without_disturbances(
    plant: LinearPlant, inputs: Sequence[np.ndarray], steps: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Returns A^i, (n, n), and what the inputs alone add in the first i steps, (n,), for i = 0 .. steps."""
    powers, moved = [np.eye(plant.n)], [np.zeros(plant.n)]
    for age in range(steps, 0, -1):
        powers.append(plant.A @ powers[-1])
        moved.append(plant.A @ moved[-1] + plant.B @ inputs[age - 1])
    return powers, moved


def _least_squares(
    plant: LinearPlant, samples: Mapping[int, np.ndarray], inputs: Sequence[np.ndarray], N: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns x_hat, (n,), and the shape (n, n) of an ellipsoid around its error; NaN where it is not observed."""
    H, D, n, w = plant.H, plant.disturbance.shape_matrix, plant.n, max(samples)
    powers, moved = _without_disturbances(plant, inputs, w)
    outputs = np.sqrt(np.diag(H @ np.diag(plant.half_widths**2) @ H.T))
    weights = 1.0 / np.maximum(np.sqrt(np.diag(N)), LEAST_SHARE * outputs)
    regressors = np.vstack([weights[:, None] * (H @ powers[w - age]) for age in samples]) * plant.half_widths
    if np.linalg.matrix_rank(regressors / np.abs(regressors).max(), LEAST_SHARE) < n:
        return np.full(n, np.nan), np.full((n, n), np.nan)
    parts = np.hsplit(powers[w] @ (plant.half_widths[:, None] * np.linalg.pinv(regressors)), len(samples))
    gains = {age: part * weights for age, part in zip(samples, parts, strict=True)}
    estimate, shape = moved[w], np.zeros((n, n))
    for age, T in gains.items():
        estimate = estimate + T @ (samples[age] - H @ moved[w - age])
        shape = outer_sum(shape, T @ N @ T.T, plant.weight)
    for left in range(w):  # steps that are left after the one in which a disturbance acted
        M = sum((T @ H @ powers[left - age] for age, T in gains.items() if age <= left), -powers[left])
        shape = outer_sum(shape, M @ D @ M.T, plant.weight)
    return estimate, shape
