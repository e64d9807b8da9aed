"""Disturbances of the full size of E(D): a random boundary point, and the one that does the most harm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ncs_gym.uncertainty.disturbance import ROUNDING, Disturbance
from ncs_gym.validation import as_covariance, as_matrix


@dataclass(frozen=True, eq=False)
class SphereDisturbance(Disturbance):
    """A random boundary point of E(D): always as large as allowed."""

    replaces_process_noise: ClassVar[bool] = True
    vectorized: ClassVar[bool] = True
    memoryless: ClassVar[bool] = True

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        count = None if nominal_next.ndim == 1 else nominal_next.shape[1]
        return (1.0 - ROUNDING) * plant.nominal_disturbance.sample_boundary(rng, count).T


@dataclass(frozen=True, eq=False)
class AdversarialDisturbance(Disturbance):
    """The point of E(D) that does the most harm to the next state.

    Attributes:
        M: Shape (n, n): maximize (x+)' M (x+). None: maximize the largest |c_j x+| of those it can move.
        rows: Shape (r, n), in place of the rows c_j of the safe box, where M is None.

    Raises:
        ValueError: If M is not symmetric positive semidefinite, or rows are no matrix.
    """

    M: np.ndarray | None = None
    rows: np.ndarray | None = None
    replaces_process_noise: ClassVar[bool] = True
    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.M is not None:
            object.__setattr__(self, "M", as_covariance(self.M, None, "M"))
        if self.rows is not None:
            object.__setattr__(self, "rows", as_matrix(self.rows, (None, None), "rows"))
        self._make_arrays_read_only()

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        bound = plant.nominal_disturbance
        if self.M is not None:
            return (1.0 - ROUNDING) * bound.farthest_point(nominal_next.T, self.M).T
        rows = plant.box_rows if self.rows is None else self.rows
        values = rows @ nominal_next
        reach = np.asarray(bound.support(rows))
        movable = reach > 0.0 if np.any(reach > 0.0) else np.ones(len(reach), np.bool_)
        worst = np.argmax(np.where(movable, np.abs(values).T + reach, -1.0).T, axis=0)
        extremes = np.stack([bound.extreme_point(row) for row in rows], axis=1)
        signs = np.where(np.take_along_axis(values, worst[None], axis=0)[0] >= 0.0, 1.0, -1.0)
        return (1.0 - ROUNDING) * signs * extremes[:, worst]

    def check(self, plant):  # noqa: D102
        if self.M is not None and self.M.shape != (plant.n, plant.n):
            return f"M must have shape ({plant.n}, {plant.n}), got {self.M.shape}"
        if self.rows is not None and self.rows.shape[1] != plant.n:
            return f"rows must have {plant.n} columns, got {self.rows.shape[1]}"
        return ""
