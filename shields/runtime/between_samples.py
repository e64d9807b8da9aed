"""What a plant that counts its box between samples asks of states and inputs (docs/shield_proof.md)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.validation import read_only

# Outward rounding of rows that are divided by what is left of the box.
_OUTWARD = 1.0 + 1e-12


class GridTest(NamedTuple):
    """|row (A_tau x_hat + B_tau u)| + support of A_tau e + disturbed <= 1 at the times tau_i, i = 1..N-1.

    Rows are those of the box, divided by what eta leaves of it; no rows for a plant that counts at samples alone.

    Attributes:
        moved: Rows on x_hat, shape (g, n).
        effect: Rows on u, shape (g, m).
        disturbed: Support of the disturbances, shape (g,).
        at_samples: Rows on the state at a sampling instant, shape (k, n), from which the box is kept until the first of
            these times: those of the box divided by what eta and the disturbances leave, or the box's own.
    """

    moved: np.ndarray
    effect: np.ndarray
    disturbed: np.ndarray
    at_samples: np.ndarray


@np.errstate(all="ignore")  # what is not finite leaves no room
def grid_test(plant: LinearPlant) -> GridTest:
    """Returns the test of a plant's grid."""
    rows, grid = plant.box_rows, plant.grid_rows
    if grid is None:
        return GridTest(np.empty((0, plant.n)), np.empty((0, plant.m)), np.empty(0), rows)
    D, rounding = plant.disturbance.shape_matrix, 8.0 * plant.n * float(np.finfo(float).eps)
    left = (1.0 - grid.remainder) / _OUTWARD
    rho = supports(rows, D[None], rounding * (np.abs(rows) @ np.sqrt(np.diag(D)))[:, None] ** 2)[:, 0]
    at_samples = np.where(left > rho, left - rho, 0.0) / _OUTWARD
    count = len(grid.state) - 1
    return GridTest(
        moved=read_only((grid.state[1:] / left[:, None]).reshape(-1, plant.n)),
        effect=read_only((grid.input[1:] / left[:, None]).reshape(-1, plant.m)),
        disturbed=read_only(np.tile(np.where(left > 0.0, rho / left, np.inf), count)),
        at_samples=read_only(rows / at_samples[:, None]),
    )


def supports(rows: np.ndarray, shapes: np.ndarray, rounding: Any) -> np.ndarray:
    """Returns upper bounds of sqrt(g S g') for rows g, (r, n), and shapes S, (k, n, n): shape (r, k).

    Args:
        rows: g, shape (r, n).
        shapes: S, shape (k, n, n).
        rounding: What computing g S g' is off by at most, for all rows, shape (k,) or a number, or shape (r, 1).
    """
    squares = ((rows @ shapes) * rows).sum(axis=-1).T
    return np.sqrt(np.maximum(squares, 0.0) + rounding)
