"""Limits within a step: rows on the state at its beginning and on the input, which stand beside those of the set."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.validation import read_only

# Outward rounding of rows that are divided by what is left of the box.
_OUTWARD = 1.0 + 1e-12
# An end of a row that is open counts as this far from the other one, in units of the row: a closer end is no less safe,
# and no set is that wide.
OPEN = 1e4


def supports(rows: np.ndarray, shapes: np.ndarray, rounding: Any) -> np.ndarray:
    """Returns upper bounds of sqrt(g S g'), shape (..., r), for rows g, (..., r, n), and shapes S, (..., n, n).

    Computing g S g' is off by at most the rounding.
    """
    squares = ((rows @ shapes) * rows).sum(axis=-1)
    return np.sqrt(np.maximum(squares, 0.0) + rounding)


class RowsWithinStep(NamedTuple):
    """Limits within a step: low <= state x + input u + disturbance <= high, of x at its beginning.

    First the rows of the box at the times tau_i, i = 1..N-1, divided by what eta leaves of half their range, none for a
    plant that counts at samples alone; then the limits of states and inputs together, which no disturbance reaches.

    Attributes:
        state: Rows on x_hat, shape (g, n).
        input: Rows on u, shape (g, m).
        low, high: Their ends, shape (g,).
        disturbed: Support of the disturbances, shape (g,).
        at_samples: Rows on the state at a sampling instant, shape (k, n), from which the box is kept until the first of
            these times: those of the box divided by what eta and the disturbances leave, or the box's own.
        low_at_samples, high_at_samples: Their ends, shape (k,).
    """

    state: np.ndarray
    input: np.ndarray
    low: np.ndarray
    high: np.ndarray
    disturbed: np.ndarray
    at_samples: np.ndarray
    low_at_samples: np.ndarray
    high_at_samples: np.ndarray

    def values(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Returns the rows at states x_hat, shape (N, n), and inputs, (N, m): shape (N, g), without any disturbance."""
        return states @ self.state.T + inputs @ self.input.T


def rows_within_step(plant: LinearPlant) -> RowsWithinStep:
    """Returns the rows of a plant's limits within a step."""
    rows, grid, n = plant.box, plant.grid_rows, plant.n
    of_state, of_input, (low, high) = plant.mixed_rows[:, :n], plant.mixed_rows[:, n:], plant.mixed_ends
    disturbed, at_samples, ends = np.zeros(len(low)), rows, plant.box_ends
    if grid is not None:
        D, rounding = plant.disturbance.shape_matrix, 8.0 * n * float(np.finfo(float).eps)
        left = (1.0 - grid.remainder) / _OUTWARD
        rho = supports(rows, D, rounding * (np.abs(rows) @ np.sqrt(np.diag(D))) ** 2)
        left_at_samples = np.where(left > rho, left - rho, 0.0) / _OUTWARD
        count = len(grid.state) - 1
        of_state = np.concatenate([(grid.state[1:] / left[:, None]).reshape(-1, n), of_state])
        of_input = np.concatenate([(grid.input[1:] / left[:, None]).reshape(-1, plant.m), of_input])
        low, high = (
            np.concatenate([np.tile(on_grid, count), mixed])
            for on_grid, mixed in zip(_shrunk(plant.box_ends, left), (low, high), strict=True)
        )
        disturbed = np.concatenate([np.tile(np.where(left > 0.0, rho / left, np.inf), count), disturbed])
        at_samples, ends = rows / left_at_samples[:, None], _shrunk(plant.box_ends, left_at_samples)
    return RowsWithinStep(*map(read_only, (of_state, of_input, low, high, disturbed, at_samples, *ends)))


def _shrunk(ends: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends of rows that are divided by what is left of half their range, shape (k,) each."""
    (low, high), some = ends, left > 0.0
    return np.where(some, (low + 1.0 - left) / left, -1.0), np.where(some, (high - 1.0 + left) / left, 1.0)


def closed(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns finite ends for ends of which one may be open."""
    return np.where(np.isfinite(low), low, high - OPEN), np.where(np.isfinite(high), high, low + OPEN)
