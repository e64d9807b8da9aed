"""What the limits of a plant say: their ends, what they allow, and how far a state or an input is beyond them."""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property

import numpy as np

from ncs_gym.plants import between_samples
from ncs_gym.validation import ReadOnlyArrays, read_only


class LimitValues(ReadOnlyArrays):
    """What follows from the limits that `LinearPlant` is declared with."""

    A: np.ndarray
    B: np.ndarray
    box: np.ndarray
    box_ends: np.ndarray
    input_ends: np.ndarray
    mixed_rows: np.ndarray
    mixed_ends: np.ndarray
    dt: float
    n: int
    m: int
    past: int
    continuous_model: np.ndarray | None
    between_samples: int | None

    @property
    def box_low(self) -> np.ndarray:
        """The low ends of c_j x, shape (k,); infinite where there is none."""
        return self.box_ends[0]

    @property
    def box_high(self) -> np.ndarray:
        """The high ends of c_j x, shape (k,); infinite where there is none."""
        return self.box_ends[1]

    @cached_property
    def input_low(self) -> np.ndarray:
        """The low ends of the inputs, shape (m,)."""
        return read_only(self.input_ends[0])

    @cached_property
    def input_high(self) -> np.ndarray:
        """The high ends of the inputs, shape (m,)."""
        return read_only(self.input_ends[1])

    @cached_property
    def input_middle(self) -> np.ndarray:
        """The input that action 0 stands for, shape (m,): the middle of the limits."""
        return read_only(0.5 * (self.input_low + self.input_high))

    @cached_property
    def input_half(self) -> np.ndarray:
        """Half the range of each input, shape (m,): input_middle +- input_half is within the limits, as floats add."""
        half = 0.5 * (self.input_high - self.input_low)
        while True:
            beyond = (self.input_middle + half > self.input_high) | (self.input_middle - half < self.input_low)
            if not beyond.any():
                return read_only(half)
            half = np.where(beyond, np.nextafter(half, 0.0), half)

    @cached_property
    def input_scales(self) -> tuple[tuple[float, float], ...]:
        """`input_middle` and `input_half` of each input as numbers."""
        return tuple(zip(self.input_middle.tolist(), self.input_half.tolist(), strict=True))

    @cached_property
    def largest_input(self) -> np.ndarray:
        """The largest |u_i| within the limits, shape (m,)."""
        return read_only(np.maximum(-self.input_low, self.input_high))

    @cached_property
    def own_limits(self) -> np.ndarray:
        """The closest limits of each state alone, low and high ends of shape (2, n); infinite where an end is open."""
        low, high = np.full((2, self.n), [[-np.inf], [np.inf]])
        for row, ends in zip(self.box, self.box_ends.T, strict=True):
            if np.count_nonzero(row) == 1:
                j = int(np.flatnonzero(row)[0])
                least, most = sorted(ends / row[j])
                low[j], high[j] = max(low[j], least), min(high[j], most)
        return read_only(np.array([low, high]))

    @cached_property
    def reach(self) -> np.ndarray:
        """The largest |x_j| in the safe box and |u_i| within the limits, shape (n + m,); infinite for a free state.

        Of states that are past inputs those are the inputs' limits, which they never leave.
        """
        two_ends = np.isfinite(self.box_ends).all(axis=0)
        limited, reach = self.box[two_ends].any(axis=0), np.full(self.n, np.inf)
        with suppress(ZeroDivisionError):  # rows that limit a sum alone
            reach[limited] = between_samples.widest(self.box[:, limited], self.box_ends)
        reach = np.minimum(reach, np.abs(self.own_limits).max(axis=0))
        reach[self.n - self.past :] = np.tile(self.largest_input, self.past // self.m)
        return read_only(np.concatenate([reach, self.largest_input]))

    @cached_property
    def grid_rows(self) -> between_samples.GridRows | None:
        """What the box says of states and inputs between samples; None if only the sampling instants count.

        Raises:
            OverflowError: If it is out of reach of float64, which the message says.
        """
        if self.between_samples is None or self.continuous_model is None:
            return None
        return between_samples.grid_rows(
            self.continuous_model, (self.box, self.box_ends), self.largest_input, self.dt, self.between_samples
        )

    def constraint_values(self, state: np.ndarray) -> np.ndarray:
        """Returns how far c_j x is beyond the nearer end, in units of half the range, for each row of the safe box.

        Shape (k,) or (k, N); positive is violated. With symmetric limits that is |c_j x| - 1.
        """
        values = self.box.dot(state)
        low, high = self._ends[values.ndim - 1]
        return np.maximum(values - high, low - values)

    @cached_property
    def _ends(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        """The low and the high ends, shape (k,), and as columns, (k, 1)."""
        low, high = read_only(self.box_low), read_only(self.box_high)
        return (low, high), (low[:, None], high[:, None])

    def mixed_values(self, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns how far the rows of `mixed_rows` are beyond the nearer end, in units of half their range.

        Shape (q,) or (q, N), for states of shape (n,) or (n, N) and inputs of shape (m,) or (m, N).
        """
        values = self.mixed_rows[:, : self.n].dot(state) + self.mixed_rows[:, self.n :].dot(u)
        low, high = self.mixed_ends if values.ndim == 1 else self.mixed_ends[:, :, None]
        return np.maximum(values - high, low - values)

    def values_at_start(self, state: np.ndarray) -> np.ndarray:
        """Returns `worst_constraint_values` where no step has been: those of a state at which the operating input acts.

        Shape (k + q,) or (k + q, N), for a state of shape (n,) or (n, N).
        """
        values = self.constraint_values(state)
        if not len(self.mixed_rows):
            return values
        return np.concatenate([values, self.mixed_values(state, np.zeros((self.m, *state.shape[1:])))])

    @cached_property
    def _grid_values(self) -> between_samples.GridValues | None:
        rows = self.grid_rows
        return None if rows is None else between_samples.GridValues(rows, (self.box, self.box_ends), self.A, self.B)

    def worst_constraint_values(self, state: np.ndarray, u: np.ndarray, x_next: np.ndarray) -> np.ndarray:
        """Returns the largest `constraint_values` of a step after its beginning, then its `mixed_values`.

        Shape (k + q,) or (k + q, N). With `between_samples` at these times of the step, what moved x+ away from A x + B
        u in proportion to the time; else at its end alone.

        Args:
            state: x at the beginning, shape (n,) or (n, N).
            u: Input that was held, shape (m,) or (m, N).
            x_next: x+, of the shape of x.
        """
        values, grid = self.constraint_values(x_next), self._grid_values
        values = values if grid is None else grid.worst(state, u, x_next, values)
        return np.concatenate([values, self.mixed_values(state, u)]) if len(self.mixed_rows) else values
