"""The phase plane: safe box, safe set, error ellipse and recent path in two coordinates."""

from __future__ import annotations

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.limits import box_in, limit_of, number, outline, titled
from ncs_gym.rendering.scene import Scene

# The axes reach this far, in units of the limits.
REACH = 1.5
# What is farther out is drawn this many pixels inside the frame.
EDGE = 7.0
# No line ends farther out than this, which pygame would take long to draw [pixels].
BEYOND = 2000.0


class PhasePlane:
    """Two coordinates of the state.

    Args:
        plant: Gives limits, names and units.
        pair: Indices of the horizontal and the vertical coordinate.
        rect: Where the axes are.
    """

    def __init__(self, plant: LinearPlant, pair: tuple[int, int], rect: theme.Rect) -> None:
        self._plant, self._pair, self.rect = plant, pair, rect
        self._limits = np.array([limit_of(plant, index) for index in pair])
        half = np.array([rect.w, -rect.h]) / 2.0
        self._center = np.array([rect.x, rect.y]) + np.abs(half)
        self._scale = half / (REACH * self._limits)

    def place(self, points: np.ndarray) -> np.ndarray:
        """Returns pixels, shape (k, 2), of points in the two coordinates, shape (k, 2)."""
        return self._center + self._scale * points

    def draw_background(self, canvas: Canvas, safe_set: np.ndarray | None) -> None:
        """Draws what stays: box, safe set with shape L (n, n), ticks and titles."""
        rect = self.rect
        canvas.rect(rect, theme.DANGER_FILL)
        canvas.clip(rect)
        box = self.place(box_in(self._plant, self._pair))
        canvas.polygon(box, theme.PAPER)
        if safe_set is not None:
            ring = self.place(self._shadow(safe_set))
            canvas.polygon(ring, theme.SAFE_FILL)
        for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
            x, y = self.place(share * self._limits)
            color = theme.FAINT if share == 0.0 else theme.GRID
            canvas.line([(x, rect.y), (x, rect.bottom)], color, 0.5)
            canvas.line([(rect.x, y), (rect.right, y)], color, 0.5)
        if safe_set is not None:
            canvas.line([*ring, ring[0]], theme.SAFE, 2.0)
        canvas.dashed([*box, box[0]], theme.DANGER, 1.5)
        canvas.clip(None)
        canvas.rect(rect, theme.FAINT, width=0.5)
        self._draw_scales(canvas)

    def draw(self, canvas: Canvas, scene: Scene) -> None:
        """Draws what moves: error ellipse, path, estimate and truth."""
        canvas.clip(self.rect)
        pair = list(self._pair)
        ellipse = self.place(scene.estimate[pair] + self._shadow(scene.error_shape)).clip(-BEYOND, BEYOND)
        canvas.polygon(ellipse, theme.ERROR_FILL)
        canvas.line([*ellipse, ellipse[0]], theme.LATE, 1.0)
        self._draw_path(canvas, scene)
        canvas.circle(self._visible(scene.estimate[pair]), 5.0, theme.ESTIMATE, width=1.5)
        truth = self._visible(scene.state[pair])
        canvas.circle(truth, 4.0, theme.DANGER if scene.violated else theme.INK)
        if scene.violated:
            canvas.circle(truth, 9.0, theme.DANGER, width=2.0)
        canvas.clip(None)

    def _draw_path(self, canvas: Canvas, scene: Scene) -> None:
        points = [self._visible(state) for state in scene.path[:, list(self._pair)]]
        count = len(points)
        for i in range(1, count):
            color = theme.blend(theme.FAINT, theme.INK, i / count)
            canvas.line(points[i - 1 : i + 1], color, 1.5)
        for point, acted in zip(points, scene.acted, strict=True):
            if acted:
                canvas.circle(point, 3.0, theme.SHIELD)

    def _shadow(self, shape: np.ndarray) -> np.ndarray:
        """Returns the outline, shape (k, 2), of an ellipsoid's projection onto the two coordinates."""
        return outline(shape[np.ix_(self._pair, self._pair)])

    def _visible(self, point: np.ndarray) -> np.ndarray:
        """Returns the pixel of a point, moved to the frame's edge if it is farther out."""
        rect = self.rect
        low, high = (rect.x + EDGE, rect.y + EDGE), (rect.right - EDGE, rect.bottom - EDGE)
        return np.clip(self.place(point), low, high)

    def _draw_scales(self, canvas: Canvas) -> None:
        rect, plant, (i, j) = self.rect, self._plant, self._pair
        for share in (-1.0, 0.0, 1.0):
            value = share * self._limits
            x, y = self.place(value)
            canvas.text(number(value[0]), (x, rect.bottom + 11), theme.MUTED, align=0.5)
            canvas.text(number(value[1]), (rect.x - 6, y), theme.MUTED, align=1.0)
        middle = rect.x + rect.w / 2, rect.bottom + 30
        canvas.text(titled(plant.state_names[i], plant.state_units[i]), middle, theme.INK, align=0.5, most=rect.w)
        middle = rect.x - 48, rect.y + rect.h / 2
        canvas.text(titled(plant.state_names[j], plant.state_units[j]), middle, theme.INK, upright=True, most=rect.h)
