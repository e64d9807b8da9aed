"""Any plant: a bar for every row of the safe box."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.lane import draw_lane
from ncs_gym.rendering.limits import reading, unit_text
from ncs_gym.rendering.scene import Scene

# Rows drawn, and rows in a column.
MOST_ROWS, COLUMN = 8, 4
TOP = theme.LANE + 27
SPACING = 28.0
# The bars reach this far, in units of the limit.
REACH = 1.3
# For names and numbers beside the bars, with one column and with two [pixels].
ROOM, LESS_ROOM = 150.0, 96.0
OUTSIDE = theme.blend(theme.DANGER_FILL, theme.DANGER, 0.15)


class BarStage:
    """Draws c_j x against its limits for each of the first rows of the box.

    Args:
        plant: Names what a row is about, if it is one state.
    """

    def __init__(self, plant: LinearPlant) -> None:
        self._rows = [_row(plant, j) for j in range(min(len(plant.C), MOST_ROWS))]
        states = [int(np.flatnonzero(row)[0]) for row in plant.C if np.count_nonzero(row) == 1]
        order = list(dict.fromkeys([*states, *range(plant.n)]))
        self.pair = (min(order[:2]), max(order[:2]))
        self._room = ROOM if len(self._rows) <= COLUMN else LESS_ROOM
        self._hidden = len(plant.C) - len(self._rows)

    def draw_background(self, canvas: Canvas) -> None:
        """Draws names, limits and tracks."""
        for i, (name, _, _, _) in enumerate(self._rows):
            track = self._track(i)
            canvas.text(name, (track.x - 10, track.y + 7), theme.INK, align=1.0, most=self._room)
            canvas.rect(track, OUTSIDE, radius=3)
            inner = track.w / REACH
            canvas.rect(theme.Rect(track.x + (track.w - inner) / 2, track.y, inner, track.h), theme.PAPER)
            for share in (-1.0, 1.0):
                x = _x(track, share)
                canvas.dashed([(x, track.y - 3), (x, track.bottom + 3)], theme.DANGER, 1.5, dash=3.0)
        if self._hidden:
            text = f"and {self._hidden} more limits"
            canvas.text(text, (theme.WIDTH - 16, theme.STAGE.bottom - 9), theme.MUTED, align=1.0)

    def draw(self, canvas: Canvas, scene: Scene) -> None:
        """Draws the values, true (bar) and estimated (dashed mark)."""
        for i, (_, unit, limit, of) in enumerate(self._rows):
            track, value, guess = self._track(i), of(scene.state), of(scene.estimate)
            color, middle = theme.strain(value), track.x + track.w / 2
            x = _x(track, value)
            canvas.rect(theme.Rect(min(x, middle), track.y + 2, abs(x - middle), track.h - 4), color)
            canvas.line([(middle, track.y - 1), (middle, track.bottom + 1)], theme.MUTED, 1.0)
            mark = _x(track, guess)
            canvas.dashed([(mark, track.y - 4), (mark, track.bottom + 4)], theme.ESTIMATE, 2.0, dash=3.0)
            text = f"{reading(value * limit, limit)} {unit}".strip()
            canvas.text(text, (track.right + 10, track.y + 7), color, bold=abs(value) > 0.8, most=self._room)
        draw_lane(canvas, scene, 130.0, theme.WIDTH - 130.0)

    def _track(self, index: int) -> theme.Rect:
        """Returns where a bar is."""
        count = len(self._rows)
        tall = min(count, COLUMN)
        y = TOP + SPACING * (index % COLUMN) + 0.5 * SPACING * (COLUMN - tall)
        if count <= COLUMN:
            return theme.Rect(170, y, 340, 14)
        return theme.Rect(110 if index < COLUMN else 420, y, 130, 14)


def _row(plant: LinearPlant, index: int) -> tuple[str, str, float, Callable[[np.ndarray], float]]:
    """Returns name, unit and limit of what a row of the box is about, and how to read it as a share of the limit."""
    row = plant.C[index]
    if np.count_nonzero(row) != 1:
        return f"limit {index + 1}", "", 1.0, lambda state: float(row @ state)
    i = int(np.flatnonzero(row)[0])
    limit = 1.0 / abs(row[i])
    return plant.state_names[i], unit_text(plant.state_units[i]), limit, lambda state: float(state[i]) / limit


def _x(track: theme.Rect, share: float) -> float:
    """Returns where a share of the limit is on a track [pixels]."""
    return track.x + track.w / 2 * (1.0 + float(np.clip(share / REACH, -1.0, 1.0)))
