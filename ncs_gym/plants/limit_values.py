"""What the limits of a plant say: their ends, what they allow, and how far a state or an input is beyond them."""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import Bounds
from ncs_gym.limits import Deviations, Limits
from ncs_gym.model import Model
from ncs_gym.plants.past_inputs import with_past_inputs
from ncs_gym.validation import ReadOnlyArrays, read_only


class LimitValues(ReadOnlyArrays):
    """The equations and the limits of a plant, counted from where it rests; past inputs are the last states.

    Attributes:
        model, limits, bounds: What they follow from.
        n, m, p: Number of states, inputs and outputs.
        A: State matrix, shape (n, n), past inputs included.
        B: Input matrix, shape (n, m).
        H: Output matrix, shape (p, n).
        dt: Duration of a step [s].
        past: How many of the last states are past inputs, the newest ones last.
        box: Rows c_j of the safe box, shape (k, n), in units of half the range that is allowed; where one end is open,
            the other one is 1 unit away.
        box_ends: The low and the high ends of c_j x, shape (2, k); -1 and 1 where limits are symmetric, infinite where
            there is none.
        is_past_row: Which rows limit past inputs, which nothing ever takes there, shape (k,).
        mixed_rows: Rows of limits on (x, u) at the beginning of a step, shape (q, n + m), in units as those of `box`.
        mixed_ends: Their low and high ends, shape (2, q).
        input_ends: The low and the high ends of the inputs, shape (2, m).
        input_middle: The input that action 0 stands for, shape (m,): the middle of the limits.
        input_half: Half the range of each input, shape (m,): input_middle +- input_half is within the limits, as floats
            add.
        input_scales: `input_middle` and `input_half` of each input as numbers.
        largest_input: The largest |u_i| within the limits, shape (m,).
        operating_state: State that deviations are counted from, shape (n,); for conversion and text.
        operating_input: Input that deviations are counted from, shape (m,).
        step_offset: Sizes of what the operating point rests under in every step beside A and B, shape (n,), which do
            not cancel: |offset|, and |E| |middle| of a disturbance with two ends.
        state_names, state_units, input_names, input_units: The labels, with defaults.
    """

    model: Model
    limits: Limits
    bounds: Bounds
    n: int
    m: int
    p: int
    A: np.ndarray
    B: np.ndarray
    H: np.ndarray
    dt: float
    past: int
    box: np.ndarray
    box_ends: np.ndarray
    is_past_row: np.ndarray
    mixed_rows: np.ndarray
    mixed_ends: np.ndarray
    input_ends: np.ndarray
    input_middle: np.ndarray
    input_half: np.ndarray
    input_scales: tuple[tuple[float, float], ...]
    largest_input: np.ndarray
    operating_state: np.ndarray
    operating_input: np.ndarray
    step_offset: np.ndarray
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]

    def _take(self, rest: Deviations) -> None:
        """Keeps what follows from the plant of its own states, counted from where it rests."""
        low, high = rest.inputs
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        while (beyond := (middle + half > high) | (middle - half < low)).any():
            half = np.where(beyond, np.nextafter(half, 0.0), half)
        whole = with_past_inputs(rest, self.model.delays, half, self.limits.change_within(half))
        number = np.arange(len(whole.box.rows)) - len(rest.box.rows)
        self._set(A=whole.A, B=whole.B, H=whole.H, dt=self.model.dt, past=whole.past)
        self._set(n=len(whole.A), m=len(half), p=len(whole.H))
        self._set(box=whole.box.rows, box_ends=np.stack(whole.box[1:]))
        self._set(is_past_row=(number >= 0) & (number < whole.past))
        self._set(mixed_rows=whole.mixed.rows, mixed_ends=np.stack(whole.mixed[1:]))
        self._set(input_ends=whole.inputs, input_middle=middle, input_half=half)
        self._set(input_scales=tuple(zip(middle.tolist(), half.tolist(), strict=True)))
        self._set(largest_input=np.maximum(-low, high), step_offset=whole.step_offset)
        self._set(operating_state=whole.state, operating_input=whole.input)

    @cached_property
    def spectral_radius(self) -> float:
        """Largest absolute eigenvalue of A; below 1 exactly when the plant is Schur stable."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

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
            reach[limited] = self._widest(limited)
        reach = np.minimum(reach, np.abs(self.own_limits).max(axis=0))
        reach[self.n - self.past :] = np.tile(self.largest_input, self.past // self.m)
        return read_only(np.concatenate([reach, self.largest_input]))

    def _widest(self, states: Any = slice(None)) -> np.ndarray:
        """Returns bounds of some |x_i| in the safe box: x = (C'C)^-1 C' (C x) for the rows C that have two ends.

        Raises:
            ZeroDivisionError: If the box does not bound each of these.
        """
        bounded = np.isfinite(self.box_ends).all(axis=0)
        rows, sizes = self.box[:, states][bounded], np.abs(self.box_ends[:, bounded]).max(axis=0)
        gram = exact.product(rows.T, rows)
        return (np.abs(exact.product(exact.inverse(gram), rows.T)) * sizes).sum(axis=1)

    def constraint_values(self, state: np.ndarray) -> np.ndarray:
        """Returns how far c_j x is beyond the nearer end, in units of half the range, for each row of the safe box.

        Shape (k,) or (k, N); positive is violated. With symmetric limits that is |c_j x| - 1.
        """
        return _beyond(self.box.dot(state), self.box_ends)

    def mixed_values(self, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns how far the rows of `mixed_rows` are beyond the nearer end, in units of half their range.

        Shape (q,) or (q, N), for states of shape (n,) or (n, N) and inputs of shape (m,) or (m, N).
        """
        rows = self.mixed_rows
        return _beyond(rows[:, : self.n].dot(state) + rows[:, self.n :].dot(u), self.mixed_ends)

    def values_at_start(self, state: np.ndarray) -> np.ndarray:
        """Returns `worst_constraint_values` where no step has been: those of a state at which the operating input acts.

        Shape (k + q,) or (k + q, N), for a state of shape (n,) or (n, N).
        """
        values = self.constraint_values(state)
        if not len(self.mixed_rows):
            return values
        return np.concatenate([values, self.mixed_values(state, np.zeros((self.m, *state.shape[1:])))])


def _beyond(values: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Returns how far values, shape (k,) or (k, N), are beyond the nearer of their ends, shape (2, k)."""
    low, high = ends if values.ndim == 1 else ends[:, :, None]
    return np.maximum(values - high, low - values)
