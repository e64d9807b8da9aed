"""What a plant does within N steps, and how far rounding can be off in computing it."""

from __future__ import annotations

import numpy as np

from ncs_gym.uncertainty.shape_matrices import SMALLEST_MULTIPLIER
from ncs_gym.validation import read_only
from shields.runtime.one_step_test import OneStepTest


class Prediction:
    """The centers c_0 = x_hat, c_{j+1} = A c_j + B u_j of the states that can be reached, j = 1..N.

    Products in float64 are off by at most `rounding` times the same products of absolute values: powers of A take j
    roundings of n-term sums, the sum over the inputs m terms per step.

    Args:
        first: The one-step test, which gives the plant and the norm of S.
        steps: N.

    Attributes:
        plant: The plant.
        steps: N.
        free: A^j, shape (N, n, n).
        forced: Block rows [A^{j-1} B, ..., B, 0, ...], shape (N, n, N m).
        size_free: |A|^j, shape (N, n, n).
        size_forced: sum_{i<j} |A|^i |B| u_max, shape (N, n).
        rounding: Relative rounding after j steps, shape (N,).
        ends: The test of section "One step" for what is reached at j: c_j + E(Sigma_pred,j) lies in S; N of them.
    """

    def __init__(self, first: OneStepTest, steps: int) -> None:
        plant, n, m = first.plant, first.plant.n, first.plant.m
        self.plant, self.steps = plant, steps
        powers, sizes = [np.eye(n)], [np.eye(n)]
        for _ in range(steps):
            powers.append(plant.A @ powers[-1])
            sizes.append(np.abs(plant.A) @ sizes[-1])
        self.free, self.size_free = read_only(np.array(powers[1:])), read_only(np.array(sizes[1:]))
        effects = np.array([power @ plant.B for power in powers[:-1]])
        forced = np.zeros((steps, n, steps, m))
        for j in range(steps):
            forced[j, :, : j + 1] = effects[j::-1].transpose(1, 0, 2)
        self.forced = read_only(forced.reshape(steps, n, steps * m))
        pushes = np.array([size @ np.abs(plant.B) @ plant.u_max for size in sizes[:-1]])
        self.size_forced = read_only(np.cumsum(pushes, axis=0))
        self.rounding = read_only(8.0 * (n + m) * (np.arange(1, steps + 1) + 2.0) * float(np.finfo(float).eps))
        self.ends = tuple(EndTest(first, self, j) for j in range(steps))
        self._free = np.ascontiguousarray(self.free.reshape(steps * n, n))
        self._forced = np.ascontiguousarray(self.forced.reshape(steps * n, steps * m))

    def centers(self, estimates: np.ndarray, plans: np.ndarray) -> np.ndarray:
        """Returns c_1..c_N, shape (N, n, E, P).

        Args:
            estimates: x_hat, shape (E, n).
            plans: Inputs of P plans for each, shape (E, P, N, m) [physical units]; zero beyond a plan's end.
        """
        count, number = plans.shape[:2]
        pushed = (self._forced @ plans.reshape(count * number, -1).T).reshape(-1, count, number)
        moved = (self._free @ estimates.T)[..., None] + pushed
        return moved.reshape(self.steps, self.plant.n, count, number)

    def centers_alone(self, estimate: np.ndarray, plans: np.ndarray) -> np.ndarray:
        """Returns what `centers` does for one estimate, shape (n,), and its plans, (P, N, m): shape (N, n, P)."""
        pushed = self._forced @ plans.reshape(len(plans), -1).T
        return (self._free.dot(estimate)[:, None] + pushed).reshape(self.steps, -1, len(plans))


class EndTest(OneStepTest):
    """The one-step test of the plant that takes j+1 steps at once: A^{j+1}, and what disturbances add up to.

    E(Q_0) + ... + E(Q_j) lies inside E(sum_i Q_i / w_i) for weights w_i > 0 of sum 1; w_i proportional to sqrt(tr Q_i)
    makes the trace smallest, also together with the estimation error that `predicted_errors` adds.

    Args:
        first: The one-step test.
        prediction: Matrices of all steps.
        index: j.
    """

    def __init__(self, first: OneStepTest, prediction: Prediction, index: int) -> None:
        plant, steps = first.plant, index + 1
        n, m = plant.n, plant.m
        self.plant, self.single, self.limits = plant, first.single, first.limits
        self.root, self.own_columns = first.root, first.own_columns
        size = np.abs(self.root)
        self.rounding = float((16.0 * (n + m) * (steps + 2) + 4.0 * n * n) * np.finfo(float).eps)
        self.moved = read_only(self.root @ prediction.free[index])
        self.effect = read_only(self.root @ prediction.forced[index])
        self.columns = read_only(np.linalg.norm(size @ prediction.size_free[index], axis=0))
        self.pushed = float(np.linalg.norm(size @ prediction.size_forced[index]))
        extents = np.sqrt(np.diag(plant.disturbance.shape))
        parts = []
        for i in range(steps):
            root = self.root @ prediction.free[i - 1] if i else self.root
            reach = size @ prediction.size_free[i - 1] if i else size
            room = self.rounding * float(np.linalg.norm(reach, axis=0) @ extents) ** 2
            parts.append(root @ plant.disturbance.shape @ root.T + room * np.eye(n))
        widths = np.sqrt([np.trace(part) for part in parts])
        widths = np.maximum(widths, SMALLEST_MULTIPLIER * widths.max())
        D = sum(part * (widths.sum() / width) for part, width in zip(parts, widths, strict=True))
        D = (1.0 + self.rounding) * np.asarray(D)
        self.D = read_only(0.5 * (D + D.T))
