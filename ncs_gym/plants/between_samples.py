"""The safe box between two sampling instants, on a grid of times (docs/shield_proof.md, "Between the samples").

With the input held, x(tau) = A_tau x + B_tau u + d_tau, where [A_tau, B_tau] is the upper part of exp(G tau) for
G = [[Ac, Bc], [0, 0]] of the model x' = Ac x + Bc u + w in continuous time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym import exact
from ncs_gym.plants.statespace import zero_order_hold
from ncs_gym.validation import read_only

MOST_POINTS = 64
# A and B of a plant are those of its model in continuous time up to this, relative to the largest entry in units of the
# limits.
SAME_MODEL = 1e-9
# What the bound between grid points is enlarged by, relative to itself and to what a row reaches: for the rounding of
# the rows, which the verification of a certificate bounds.
MARGIN, ROUNDING = 0.01, 1e-12


class GridRows(NamedTuple):
    """What the rows c of the safe box say about x and u at the times tau_i = i dt / N of a step, i = 0..N-1.

    Attributes:
        state: c A_tau, shape (N, k, n); those of i = 0 are the rows themselves.
        input: c B_tau, shape (N, k, m).
        remainder: eta, shape (k,): while x is in the box and u within its limits, c (A_tau x + B_tau u) is nowhere
            beyond its values at the two grid points around tau by more than this, the rounding of the rows included.
    """

    state: np.ndarray
    input: np.ndarray
    remainder: np.ndarray


def generator(model: np.ndarray) -> np.ndarray:
    """Returns G = [[Ac, Bc], [0, 0]], shape (n + m, n + m), of [Ac, Bc], shape (n, n + m)."""
    n, size = model.shape
    return np.concatenate([model, np.zeros((size - n, size))])


def widest(box: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Returns bounds of |x_i| in the safe box, shape (n,): x = (C'C)^-1 C' (C x) for the rows C that have two ends.

    Args:
        box: All rows, shape (k, n).
        ends: Their low and high ends, shape (2, k).

    Raises:
        ZeroDivisionError: If the box does not bound every state.
    """
    bounded = np.isfinite(ends).all(axis=0)
    rows, sizes = box[bounded], np.abs(ends[:, bounded]).max(axis=0)
    gram = exact.product(rows.T, rows)
    return (np.abs(exact.product(exact.inverse(gram), rows.T)) * sizes).sum(axis=1)


def grid_rows(
    model: np.ndarray, box: tuple[np.ndarray, np.ndarray], largest_input: np.ndarray, dt: float, points: int
) -> GridRows:
    """Returns the rows on the grid; every number is the same on every machine.

    Between two grid points a function leaves its linear interpolation by at most h^2/8 times its largest second
    derivative, here [c, 0] G^2 exp(G tau) (x, u). In the norm |q|_W = sum |q_j| W_j, with W the largest |x_j| and
    |u_j|, that grows from one grid point to the next by at most exp(h m), m the logarithmic norm of G.

    Args:
        model: [Ac, Bc], shape (n, n + m).
        box: c, shape (k, n), and its ends, shape (2, k).
        largest_input: Largest |u_i| within the limits, shape (m,).
        dt: Duration of a step [s].
        points: N.

    Raises:
        ZeroDivisionError: If the box does not bound every state.
        OverflowError: If a number of them is out of reach of float64.
    """
    try:
        return _grid_rows(model, box, largest_input, dt, points)
    except OverflowError as error:
        raise OverflowError(
            "the bound between samples is out of reach of float64: a shorter dt or closer limits would help"
        ) from error


def _grid_rows(
    model: np.ndarray, box: tuple[np.ndarray, np.ndarray], largest_input: np.ndarray, dt: float, points: int
) -> GridRows:
    G, (k, n), h = generator(model), box[0].shape, dt / points
    W = np.concatenate([widest(*box), largest_input])
    rows = np.concatenate([box[0], np.zeros((k, len(largest_input)))], axis=1)
    onward = [rows] + [exact.product(rows, exact.exponential(G, dt * i / points)) for i in range(1, points)]
    bends = [exact.product(np.abs(exact.product(each, G, G)), W) for each in onward]
    sizes = [exact.product(np.abs(each), W) for each in onward]
    growth = float(exact.exponential(np.array([[logarithmic_norm(G, W)]]), h)[0, 0])
    remainder = (1.0 + MARGIN) * (h * h / 8.0) * growth * np.max(bends, axis=0) + ROUNDING * np.max(sizes, axis=0)
    stacked = np.array(onward)
    return GridRows(read_only(stacked[..., :n]), read_only(stacked[..., n:]), read_only(remainder))


def logarithmic_norm(G: np.ndarray, W: np.ndarray) -> float:
    """Returns m = max_i (G_ii + sum_{j != i} |G_ij| W_j / W_i), at least 0.

    In the norm max |z_j| / W_j of columns, and so in |q|_W of rows, |exp(G s)| <= exp(s m).
    """
    off = np.abs(G) * (1.0 - np.eye(len(G)))
    return max(float((np.diag(G) + exact.product(off, W) / W).max()), 0.0)


def require_model_of(model: np.ndarray, A: np.ndarray, B: np.ndarray, dt: float, widths: np.ndarray) -> None:
    """Raises ValueError unless A and B are those of [Ac, Bc], shape (n, n + m), with the input held over a step.

    Entries are compared in units of the limits, `widths` of shape (n + m,).
    """
    n = len(A)
    sampled = np.concatenate(zero_order_hold(model[:, :n], model[:, n:], dt), axis=1)
    sampled, given = (each * widths / widths[:n, None] for each in (sampled, np.concatenate([A, B], axis=1)))
    if not (np.abs(sampled - given) <= SAME_MODEL * np.abs(given).max()).all():
        raise ValueError(
            "continuous of the Model is not the one that A and B were sampled from: make it by Model.sampled, or give "
            "continuous=None"
        )


class GridValues:
    """The constraint values at the grid points within a step of a simulation, given its two ends.

    What a disturbance did to the step, d = x+ - A x - B u, has come in proportion to the time: d_tau = (tau / dt) d,
    which lies in E(D) as d does. So c x(tau_i) is a sum of products with x, u and x+.

    Args:
        rows: Of the plant.
        box: c, shape (k, n), and its ends, shape (2, k).
        A, B: Of the plant.
    """

    def __init__(self, rows: GridRows, box: tuple[np.ndarray, np.ndarray], A: np.ndarray, B: np.ndarray) -> None:
        points, k, _ = rows.state.shape
        box_rows, self._ends = box
        shares = (np.arange(1, points) / points)[:, None, None]
        moved = rows.state[1:] - shares * (box_rows @ A)
        pushed = rows.input[1:] - shares * (box_rows @ B)
        joint = np.concatenate([moved, pushed, shares * box_rows], axis=2)
        self._shape, self._joint = (points - 1, k), np.ascontiguousarray(joint.reshape((points - 1) * k, -1))

    def worst(self, state: np.ndarray, u: np.ndarray, x_next: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Returns the largest values since the last sample, shape (k,) or (k, N); never below those at the end.

        Args:
            state: x, shape (n,) or (n, N).
            u: Applied input, shape (m,) or (m, N).
            x_next: x+, of the shape of x.
            values: Those of x+, shape (k,) or (k, N).
        """
        reached = self._joint.dot(np.concatenate([state, u, x_next])).reshape(*self._shape, *values.shape[1:])
        low, high = self._ends if values.ndim == 1 else self._ends[:, :, None]
        beyond = np.maximum(reached.max(axis=0) - high, low - reached.min(axis=0))
        return np.maximum(beyond, values)
