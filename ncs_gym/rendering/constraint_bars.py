"""The drawing of any other plant: a bar for every constraint of the safe box."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ncs_gym.plants.description import limited_sum
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.past_inputs import is_row_of_past_input
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import FrameRecord
from ncs_gym.rendering.packet_animation import draw_packets

# The largest number of bars, and of bars in one column.
_MAX_BARS, _COLUMN = 8, 4
_TOP = theme.PACKET_LINE + 27
_SPACING = 28.0
# The bars reach this far from the middle of the limits, in units of half their range.
_BAR_REACH = 1.3
# Widths of the names and numbers beside the bars, with one column and with two [pixels].
_TEXT_WIDTH, _NARROW_TEXT_WIDTH = 150.0, 92.0
_OUTSIDE = theme.blend(theme.DANGER_FILL, theme.DANGER, 0.15)


class _Constraint(NamedTuple):
    """One row of the safe box.

    Attributes:
        name: Name of the state it limits, or their sum.
        unit: Unit of that state.
        half: Half the range of that state, in its unit.
        center: Its operating point, in its unit.
        low, high: The limits in units of half the range; infinite where there is none.
        load: Maps a state, shape (n,), to what is limited, in these units.
    """

    name: str
    unit: str
    half: float
    center: float
    low: float
    high: float
    load: Callable[[np.ndarray], float]

    @property
    def middle(self) -> float:
        """Where the middle of a bar is; the operating point where a limit is open."""
        return 0.5 * (self.low + self.high) if np.isfinite(self.low + self.high) else 0.0


class ConstraintBarsDrawing:
    """Draws c_j x against its limits for each of the first rows of the safe box, but for those of past inputs.

    Args:
        plant: The plant, which names the states that the rows are about.

    Attributes:
        pair: The states in the phase plane: the first two that have a limit of their own.
    """

    def __init__(self, plant: LinearPlant) -> None:
        rows = np.flatnonzero(~is_row_of_past_input(plant)).tolist()
        self._constraints = [_constraint(plant, j) for j in rows[:_MAX_BARS]]
        limited = [int(np.flatnonzero(plant.box[j])[0]) for j in rows if np.count_nonzero(plant.box[j]) == 1]
        order = list(dict.fromkeys([*limited, *range(plant.n)]))
        self.pair = (min(order[:2]), max(order[:2]))
        self._text_width = _TEXT_WIDTH if len(self._constraints) <= _COLUMN else _NARROW_TEXT_WIDTH
        self._hidden = len(rows) - len(self._constraints)

    def draw_background(self, canvas: Canvas) -> None:
        """Draws the names, the empty bars and the limits."""
        for i, constraint in enumerate(self._constraints):
            bar = self._bar(i)
            place = bar.x - 10, bar.y + 7
            canvas.text(constraint.name, place, theme.INK, align=1.0, max_width=self._text_width)
            canvas.rect(bar, _OUTSIDE, radius=3)
            left, right = (_x(bar, constraint, end) for end in (constraint.low, constraint.high))
            canvas.rect(theme.Rect(left, bar.y, right - left, bar.h), theme.PAPER)
            for x, end in ((left, constraint.low), (right, constraint.high)):
                if not np.isfinite(end):
                    continue
                canvas.dashed([(x, bar.y - 3), (x, bar.bottom + 3)], theme.DANGER, 1.5, dash=3.0)
        if self._hidden:
            text = f"and {self._hidden} more limits"
            canvas.text(text, (theme.WIDTH - 16, theme.PLANT_VIEW.bottom - 9), theme.MUTED, align=1.0)

    def draw(self, canvas: Canvas, frame: FrameRecord) -> None:
        """Draws the true values as bars, the estimated ones as dashed marks, and the packets."""
        for i, constraint in enumerate(self._constraints):
            bar, value = self._bar(i), constraint.load(frame.state)
            used = max(value / constraint.low, value / constraint.high)
            color, zero = theme.load_color(used), _x(bar, constraint, 0.0)
            x = _x(bar, constraint, value)
            canvas.rect(theme.Rect(min(x, zero), bar.y + 2, abs(x - zero), bar.h - 4), color)
            canvas.line([(zero, bar.y - 1), (zero, bar.bottom + 1)], theme.MUTED, 1.0)
            estimated = _x(bar, constraint, constraint.load(frame.estimate))
            canvas.dashed([(estimated, bar.y - 4), (estimated, bar.bottom + 4)], theme.ESTIMATE, 2.0, dash=3.0)
            text = theme.value_label(constraint.center + value * constraint.half, constraint.half, constraint.unit)
            place, violated = (bar.right + 10, bar.y + 7), used > 1.0
            text_color = theme.DANGER if violated else theme.INK
            canvas.text(text, place, text_color, bold=violated, max_width=self._text_width)
        draw_packets(canvas, frame, 130.0, theme.WIDTH - 130.0)

    def _bar(self, index: int) -> theme.Rect:
        count = len(self._constraints)
        y = _TOP + _SPACING * (index % _COLUMN) + 0.5 * _SPACING * (_COLUMN - min(count, _COLUMN))
        if count <= _COLUMN:
            return theme.Rect(170, y, 340, 14)
        return theme.Rect(118 if index < _COLUMN else 432, y, 100, 14)


def _constraint(plant: LinearPlant, index: int) -> _Constraint:
    row, low, high = plant.box[index], float(plant.box_low[index]), float(plant.box_high[index])
    if np.count_nonzero(row) != 1:
        terms, size, center = limited_sum(plant, index)
        return _Constraint(terms, "", 1.0 / size, center, low, high, lambda state: float(row @ state))
    i = int(np.flatnonzero(row)[0])
    half, (low, high) = 1.0 / abs(row[i]), (low, high) if row[i] > 0.0 else (-high, -low)
    name, unit, center = plant.state_names[i], plant.state_units[i], float(plant.operating_state[i])
    return _Constraint(name, unit, half, center, low, high, lambda state: float(state[i]) / half)


def _x(bar: theme.Rect, constraint: _Constraint, load: float) -> float:
    """Returns where what is limited is on a bar [pixels]."""
    return bar.x + bar.w / 2 * (1.0 + float(np.clip((load - constraint.middle) / _BAR_REACH, -1.0, 1.0)))
