"""The safe box between two sampling instants, on a grid of times (docs/shield_proof.md, "Between the samples").

With the input held, x(tau) = A_tau x + B_tau u + d_tau, where [A_tau, B_tau] is the upper part of exp(G tau) for
G = [[Ac, Bc], [0, 0]].
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import Bounds
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.hard_bounds import HardBounds
from ncs_gym.validation import read_only, setting

# What the bound between grid points gains for the rounding of rows, relative to itself and to what a row reaches.
MARGIN, ROUNDING = 0.01, 1e-12


class GridRows(NamedTuple):
    """The rows c of the safe box as rows on x and u at the times tau_i = i dt / N of a step, i = 0..N-1.

    Attributes:
        state: c A_tau, shape (N, k, n).
        input: c B_tau, shape (N, k, m).
        remainder: eta, shape (k,): for x in the box and u within its limits, c (A_tau x + B_tau u) is nowhere beyond
            its values at the two grid points around tau by more than this, the rounding of the rows included.
    """

    state: np.ndarray
    input: np.ndarray
    remainder: np.ndarray


class BetweenSamples(HardBounds):
    """What the limits say of times between samples.

    Attributes:
        state_names, state_units, input_names, input_units: The labels, with defaults.
        dt, continuous_model: Those of the model.
        between_samples: That of the limits.
    """

    model: Model
    limits: Limits
    bounds: Bounds
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    dt = setting("dt", "model.dt")
    continuous_model = setting("continuous_model", "model.continuous")
    between_samples = setting("between_samples", "limits.between_samples")

    @cached_property
    def grid_rows(self) -> GridRows | None:
        """What the box says between samples, the same on every machine; None if only the sampling instants count.

        Between two grid points a function leaves its linear interpolation by at most h^2/8 times its largest second
        derivative, here [c, 0] G^2 exp(G tau) (x, u). In the norm |q|_W = sum |q_j| W_j, with W the largest |x_j| and
        |u_j|, that grows from one grid point to the next by at most exp(h m), m the logarithmic norm of G.

        Raises:
            OverflowError: If it is out of reach of float64.
        """
        model, points = self.continuous_model, self.between_samples
        if points is None:
            return None
        G, h = np.concatenate([model, np.zeros((self.m, self.n + self.m))]), self.dt / points
        rows, W = np.pad(self.box, ((0, 0), (0, self.m))), np.concatenate([self._widest(), self.largest_input])
        try:
            times = [self.dt * i / points for i in range(1, points)]
            onward = [rows, *(exact.product(rows, exact.exponential(G, time)) for time in times)]
            bends = [exact.product(np.abs(exact.product(each, G, G)), W) for each in onward]
            sizes = [exact.product(np.abs(each), W) for each in onward]
            growth = float(exact.exponential(np.array([[_logarithmic_norm(G, W)]]), h)[0, 0])
        except OverflowError as error:
            raise OverflowError(
                "the bound between samples is out of reach of float64: a shorter dt or closer limits would help"
            ) from error
        remainder = (1.0 + MARGIN) * (h * h / 8.0) * growth * np.max(bends, axis=0) + ROUNDING * np.max(sizes, axis=0)
        state, applied = np.split(np.array(onward), [self.n], axis=2)
        return GridRows(read_only(state), read_only(applied), read_only(remainder))

    @cached_property
    def _rows_within_step(self) -> np.ndarray | None:
        """Rows on (x, u, x+) that are c x(tau_i), i = 1..N-1, shape ((N - 1) k, 2 n + m); None as of `grid_rows`.

        What a disturbance did has come in proportion to the time: d_tau = (tau / dt) (x+ - A x - B u) is in E(D), too.
        """
        if (rows := self.grid_rows) is None:
            return None
        shares = (np.arange(1, len(rows.state)) / len(rows.state))[:, None, None]
        moved, pushed = rows.state[1:] - shares * (self.box @ self.A), rows.input[1:] - shares * (self.box @ self.B)
        return np.concatenate([moved, pushed, shares * self.box], axis=2).reshape(-1, 2 * self.n + self.m)

    def worst_constraint_values(self, state: np.ndarray, u: np.ndarray, x_next: np.ndarray) -> np.ndarray:
        """Returns the largest `constraint_values` of a step after its beginning, then its `mixed_values`.

        Shape (k + q,) or (k + q, N), for x, x+ of shape (n,) or (n, N) and the input that was held, (m,) or (m, N).
        """
        values, rows = self.constraint_values(x_next), self._rows_within_step
        if rows is not None:
            reached = rows.dot(np.concatenate([state, u, x_next])).reshape(-1, *values.shape)
            low, high = self.box_ends if values.ndim == 1 else self.box_ends[:, :, None]
            values = np.maximum(np.maximum(reached.max(axis=0) - high, low - reached.min(axis=0)), values)
        return np.concatenate([values, self.mixed_values(state, u)]) if len(self.mixed_rows) else values

    def _check_between_samples(self) -> None:
        """Raises ValueError if times between samples count of which nothing is known."""
        if self.between_samples is None:
            return
        has_remainder = any(each.is_left_out for each in self.bounds.disturbance.parts)
        if self.continuous_model is None or self.past or has_remainder or self.step_offset.any():
            needed = "a model of Model.sampled, without delays, rates, remainder and constant disturbance"
            raise ValueError(f"between_samples needs {needed}: else nothing is known of times within a step")
        if exact.rank(self.box[np.isfinite(self.box_ends).all(axis=0)]) < self.n:
            raise ValueError("between_samples needs Limits with two ends that bound every state: give generous ones")


def _logarithmic_norm(G: np.ndarray, W: np.ndarray) -> float:
    """Returns m = max_i (G_ii + sum_{j != i} |G_ij| W_j / W_i), at least 0.

    In the norm max |z_j| / W_j of columns, and so in |q|_W of rows, |exp(G s)| <= exp(s m).
    """
    off = np.abs(G) * (1.0 - np.eye(len(G)))
    return max(float((np.diag(G) + exact.product(off, W) / W).max()), 0.0)
