"""The truck and its trailer."""

from __future__ import annotations

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.lane import draw_lane
from ncs_gym.rendering.limits import limit_of, number, reading
from ncs_gym.rendering.scene import Scene

ROAD = theme.STAGE.bottom - 24
# The truck's hitch stands still; the coupling at rest is this long, and its limit this many pixels away.
HITCH, REST, LIMIT = 402.0, 106.0, 62.0
TRAILER, TRUCK = 150.0, 176.0
AXLE, WHEEL = ROAD - 13, 12.0
# Farther out the trailer is drawn at the stage's edge.
FARTHEST = 1.9
# Pixels the marks of the road move per meter driven, and their spacing.
ROAD_SCALE, ROAD_MARKS = 1.5, 56.0


class TruckStage:
    """Draws truck, trailer and coupling; the front of the trailer moves between the marks of its limits.

    Args:
        plant: Its first state is the stretch of the coupling.
    """

    pair = (0, 1)

    def __init__(self, plant: LinearPlant) -> None:
        self._limit = limit_of(plant, 0)

    def draw_background(self, canvas: Canvas) -> None:
        """Draws the road and the marks of the limits."""
        canvas.line([(0, ROAD), (theme.WIDTH, ROAD)], theme.FAINT, 1.5)
        for share in (-1.0, 0.0, 1.0):
            x = self._front(share * self._limit)
            canvas.text(number(share * self._limit) + (" m" if share else ""), (x, ROAD + 13), theme.MUTED, align=0.5)
            if share:
                canvas.dashed([(x, ROAD - 72), (x, ROAD + 5)], theme.DANGER, 1.5, dash=4.0)
        canvas.line([(self._front(self._limit), ROAD), (self._front(-self._limit), ROAD)], theme.SAFE, 3.0)

    def draw(self, canvas: Canvas, scene: Scene) -> None:
        """Draws what moves."""
        for x in np.arange(-scene.distance * ROAD_SCALE % ROAD_MARKS, theme.WIDTH, ROAD_MARKS):
            canvas.line([(x, ROAD + 21), (x + 22, ROAD + 21)], theme.FAINT, 1.5)
        stretch, front = float(scene.state[0]), self._front(float(scene.state[0]))
        self._draw_coupling(canvas, front, stretch)
        _draw_trailer(canvas, front)
        _draw_ghost(canvas, self._front(float(scene.estimate[0])))
        _draw_truck(canvas)
        canvas.line([(front - 0.5 * TRAILER, ROAD - 66), (front - 0.5 * TRAILER, theme.LANE + 8)], theme.FAINT, 1.0)
        canvas.line([(HITCH + 138, ROAD - 78), (HITCH + 138, theme.LANE + 8)], theme.FAINT, 1.0)
        draw_lane(canvas, scene, front - 0.5 * TRAILER, HITCH + 138)

    def _front(self, stretch: float) -> float:
        """Returns where the front of the trailer is at a stretch [m]."""
        return HITCH - REST - LIMIT * float(np.clip(stretch / self._limit, -1.5, FARTHEST))

    def _draw_coupling(self, canvas: Canvas, front: float, stretch: float) -> None:
        """Draws a spring that turns red, and its stretch."""
        color = theme.strain(stretch / self._limit)
        y, teeth = AXLE - 12, 7
        xs = np.linspace(front + 10, HITCH - 10, 2 * teeth + 1)
        ys = y + 9.0 * np.array([0.0, *([1.0, -1.0] * teeth)[:-1], 0.0])
        canvas.line([(front - 2, y), *zip(xs, ys, strict=True), (HITCH + 2, y)], color, 3.0)
        text, middle = f"{reading(stretch, self._limit)} m", HITCH - 30
        canvas.text(text, (middle, ROAD - 88), color, theme.LARGE, align=0.5, bold=True)


def _draw_wheels(canvas: Canvas, *xs: float) -> None:
    for x in xs:
        canvas.circle((x, AXLE), WHEEL, theme.INK)
        canvas.circle((x, AXLE), 5.0, theme.FAINT)


def _draw_trailer(canvas: Canvas, front: float) -> None:
    left = front - TRAILER
    canvas.rect(theme.Rect(left, ROAD - 66, TRAILER, 46), theme.LOAD, radius=4)
    for share in (0.25, 0.5, 0.75):
        x = left + share * TRAILER
        canvas.line([(x, ROAD - 62), (x, ROAD - 25)], theme.CRATE, 1.5)
    canvas.rect(theme.Rect(left, ROAD - 22, TRAILER, 6), theme.INK, radius=2)
    _draw_wheels(canvas, left + 28, left + 56, left + TRAILER - 26)


def _draw_ghost(canvas: Canvas, front: float) -> None:
    left, top, bottom = front - TRAILER, ROAD - 70, ROAD - 14
    corners = [(left, bottom), (left, top), (front, top), (front, bottom), (left, bottom)]
    canvas.dashed(corners, theme.ESTIMATE, 1.75, dash=5.0)


def _draw_truck(canvas: Canvas) -> None:
    body = theme.BODYWORK
    canvas.rect(theme.Rect(HITCH, ROAD - 24, TRUCK, 9), theme.INK, radius=3)
    canvas.rect(theme.Rect(HITCH + 8, ROAD - 52, 84, 28), theme.CRATE, radius=3)
    cab = [(HITCH + 100, ROAD - 78), (HITCH + 152, ROAD - 78), (HITCH + 166, ROAD - 48)]
    canvas.polygon([*cab, (HITCH + TRUCK, ROAD - 45), (HITCH + TRUCK, ROAD - 16), (HITCH + 100, ROAD - 16)], body)
    window = [(HITCH + 118, ROAD - 71), (HITCH + 148, ROAD - 71), (HITCH + 158, ROAD - 48), (HITCH + 118, ROAD - 48)]
    canvas.polygon(window, theme.GLASS)
    _draw_wheels(canvas, HITCH + 34, HITCH + 62, HITCH + 144)
