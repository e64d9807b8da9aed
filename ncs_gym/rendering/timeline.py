"""In place of the phase plane for a plant of one state: that state over the recent steps."""

from __future__ import annotations

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.history import RECENT
from ncs_gym.rendering.limits import limit_of, number, titled
from ncs_gym.rendering.plane import REACH
from ncs_gym.rendering.scene import Scene


class Timeline:
    """The only state of a plant, against time.

    Args:
        plant: Of one state.
        rect: Where the axes are.
    """

    def __init__(self, plant: LinearPlant, rect: theme.Rect) -> None:
        self._plant, self._rect, self._limit = plant, rect, limit_of(plant, 0)

    def draw_background(self, canvas: Canvas, safe_set: np.ndarray | None) -> None:
        """Draws limits, the safe set with shape L (1, 1), ticks and titles."""
        rect, plant = self._rect, self._plant
        canvas.rect(rect, theme.DANGER_FILL)
        top, bottom = self._y(self._limit), self._y(-self._limit)
        canvas.rect(theme.Rect(rect.x, top, rect.w, bottom - top), theme.PAPER)
        if safe_set is not None:
            high = float(np.sqrt(safe_set[0, 0]))
            top, bottom = self._y(high), self._y(-high)
            canvas.rect(theme.Rect(rect.x, top, rect.w, bottom - top), theme.SAFE_FILL)
            for y in (top, bottom):
                canvas.line([(rect.x, y), (rect.right, y)], theme.SAFE, 2.0)
        for share in (-1.0, 0.0, 1.0):
            y = self._y(share * self._limit)
            canvas.text(number(share * self._limit), (rect.x - 6, y), theme.MUTED, align=1.0)
            ends = [(rect.x, y), (rect.right, y)]
            if share:
                canvas.dashed(ends, theme.DANGER, 1.5)
            else:
                canvas.line(ends, theme.FAINT, 0.5)
        canvas.rect(rect, theme.FAINT, width=0.5)
        for back in (0, RECENT // 2, RECENT):
            canvas.text(number(-back), (self._x(back), rect.bottom + 11), theme.MUTED, align=0.5)
        canvas.text("time [steps]", (rect.x + rect.w / 2, rect.bottom + 30), theme.INK, align=0.5)
        title = titled(plant.state_names[0], plant.state_units[0])
        canvas.text(title, (rect.x - 48, rect.y + rect.h / 2), theme.INK, upright=True, most=rect.h)

    def draw(self, canvas: Canvas, scene: Scene) -> None:
        """Draws the path, the error bound as a bar, estimate and truth."""
        canvas.clip(self._rect)
        count = len(scene.path)
        points = [(self._x(count - 1 - i), self._y(float(scene.path[i, 0]))) for i in range(count)]
        if count > 1:
            canvas.line(points, theme.MUTED, 1.5)
        for point, acted in zip(points, scene.acted, strict=True):
            if acted:
                canvas.circle(point, 3.0, theme.SHIELD)
        x, guess, width = self._x(0), float(scene.estimate[0]), float(np.sqrt(scene.error_shape[0, 0]))
        canvas.line([(x, self._y(guess - width)), (x, self._y(guess + width))], theme.LATE, 3.0)
        canvas.circle((x, self._y(guess)), 5.0, theme.ESTIMATE, width=1.5)
        canvas.circle(points[-1], 4.0, theme.DANGER if scene.violated else theme.INK)
        canvas.clip(None)

    def _x(self, back: float) -> float:
        """Returns where a number of steps ago is [pixels]."""
        return self._rect.right - 12 - (self._rect.w - 24) * back / RECENT

    def _y(self, value: float) -> float:
        """Returns where a value is [pixels]."""
        half = self._rect.h / 2
        return self._rect.y + half - (half - 2) * float(np.clip(value / (REACH * self._limit), -1.0, 1.0))
