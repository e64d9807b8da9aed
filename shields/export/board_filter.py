"""The filter on a board, read in Python from the same table: for test vectors, and to rehearse a loop."""

from __future__ import annotations

import numpy as np

from shields.export.board_table import BoardTable

SAFE, PROJECTED, FALLBACK, INVALID = range(4)
(
    GUARANTEED, ALARM, OTHER_INPUT, NOT_FINITE, FAR_OUT, LOST_CONTRACT, STOPPED, NOT_KNOWN_INSIDE, OLD_SAMPLE,
) = range(9)  # fmt: skip


class BoardFilter:
    """What `ncs_filter.c` does, in the same order of operations: equal numbers where nothing is contracted.

    Args:
        table: Its numbers.
        episode: Number of the episode.
        estimate: The first estimate, shape (n,), whose error lies in the plant's `initial_error`.

    Attributes:
        estimate: x_hat at this step, shape (n,).
        step: Number of this step.
        age: Steps since the newest sample used was taken.
        reason: Why the state was not proved safe at the step of the last decision; GUARANTEED if it was.
    """

    @np.errstate(all="ignore")
    def __init__(self, table: BoardTable, episode: int, estimate: np.ndarray) -> None:
        self.table, self.episode, self.step, self.age = table, episode, 0, 0
        self.estimate = self._base = np.array(estimate, np.float64)
        self._inputs: list[np.ndarray] = []
        self._broken = GUARANTEED
        away = np.abs(_product(table.G, self.estimate) - table.middle.astype(np.float64))
        self._inside = bool((away <= table.start).all())
        self.reason = GUARANTEED if self._inside else NOT_KNOWN_INSIDE
        self._look_at(self.estimate)

    @np.errstate(all="ignore")
    def receive(self, episode: int, stamp: int, measurement: np.ndarray) -> bool:
        """Takes in a sample, shape (p,), and returns whether it is used."""
        table, age, ages = self.table, (self.step - stamp) % 2**32, len(self.table.T)
        if episode != self.episode or age >= min(ages, self.age):
            return False
        if not np.isfinite(measurement).all():
            self._lose(NOT_FINITE)
            return False
        gap = self.age - age
        if gap > ages:
            self._lose(LOST_CONTRACT)
        j = min(gap, ages) - 1
        back = len(self._inputs) - age
        x = self._base
        for u in self._inputs[:back]:
            x = self._predicted(x, u)
        left = measurement - _product(table.H, x)
        if not (np.abs(left) <= table.alarm[j]).all():
            self._lose(ALARM)
        self._base, self._inputs, self.age = x + _product(table.T[j], left), self._inputs[back:], age
        self._look_at(self._base)
        self._predict_from_base()
        return True

    @np.errstate(all="ignore")
    def decide(self, proposed: np.ndarray) -> tuple[int, np.ndarray]:
        """Returns the decision about a proposal, shape (m,), and the input to apply; then the next step begins."""
        table, is_old = self.table, self.age >= len(self.table.limit)
        self.reason = self._broken or (
            NOT_KNOWN_INSIDE if not self._inside else OLD_SAMPLE if is_old else GUARANTEED
        )  # fmt: skip
        decision = SAFE if np.isfinite(proposed).all() else INVALID
        u = np.minimum(np.maximum(proposed, table.low), table.high)
        proved = decision == SAFE and self._passes(u)
        if decision == SAFE and not proved:
            decision, u = PROJECTED, self._projected(u)
            proved = len(u) == 1 and self._passes(u)
        if not proved:
            decision = INVALID if decision == INVALID else FALLBACK
            u = _product(table.K, self.estimate, table.constant)
            u = np.where(np.isfinite(u), np.minimum(np.maximum(u, table.low), table.high), 0.0)
            proved = self._passes(u)
        self._inside = proved or (self._inside and not is_old)
        if len(self._inputs) == len(table.T):
            self._base = self._predicted(self._base, self._inputs.pop(0))
        self._inputs.append(u)
        self.estimate = self._predicted(self.estimate, u)
        self.step, self.age = self.step + 1, self.age + 1
        return decision, u

    @np.errstate(all="ignore")
    def applied(self, u: np.ndarray) -> None:
        """Says what the actuator applied of the last decision, shape (m,), before the next sample."""
        if self._inputs and np.array_equal(self._inputs[-1], u):
            return
        self._lose(OTHER_INPUT)
        if self._inputs and np.isfinite(u).all():
            self._inputs[-1] = np.array(u, np.float64)
            self._predict_from_base()

    def _passes(self, u: np.ndarray) -> bool:
        table = self.table
        if self.age >= len(table.limit):
            return False
        return bool((np.abs(self._center(u)) <= table.limit[self.age] - self._rounding()).all())

    def _projected(self, u: np.ndarray) -> np.ndarray:
        table = self.table
        if len(u) > 1 or self.age >= len(table.limit):
            return u
        moved = table.joint[:, -1] != 0.0
        gain, center = table.joint[moved, -1], self._center(np.zeros(1))[moved]
        room = table.limit[self.age][moved] - 3 * self._rounding() - table.limit.dtype.type(table.margin)
        ends = (-room - center) / gain, (room - center) / gain
        low = max(table.low[0], *np.where(gain > 0.0, *ends))
        high = min(table.high[0], *np.where(gain < 0.0, *ends))
        return np.minimum(np.maximum(u, low), high) if low <= high else u

    def _center(self, u: np.ndarray) -> np.ndarray:
        return _product(self.table.joint, np.concatenate([self.estimate, u])) - self.table.middle

    def _rounding(self) -> np.floating:
        """What rounding takes off every limit, in the precision of the rows."""
        lost = 0.0
        for each, size in zip(self.table.rounding.tolist(), np.abs(self.estimate).tolist(), strict=True):
            lost += each * size
        return self.table.limit.dtype.type(lost)

    def _predict_from_base(self) -> None:
        self.estimate = self._base
        for u in self._inputs:
            self.estimate = self._predicted(self.estimate, u)

    def _predicted(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        x = _product(self.table.B, u, _product(self.table.A, x))
        self._look_at(x)
        return x

    def _look_at(self, x: np.ndarray) -> None:
        if not (np.abs(x) <= self.table.far).all():
            self._lose(FAR_OUT)

    def _lose(self, reason: int) -> None:
        self._broken = self._broken or reason


def _product(matrix: np.ndarray, vector: np.ndarray, first: np.ndarray | float = 0.0) -> np.ndarray:
    """Returns first + matrix @ vector, row by row in the order of the columns."""
    total = np.full(len(matrix), first, matrix.dtype)
    for column, value in zip(matrix.T, vector.tolist(), strict=True):
        total = total + column * matrix.dtype.type(value)
    return total
