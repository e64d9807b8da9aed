"""The cart and its pole."""

from __future__ import annotations

from math import cos, sin

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.lane import draw_lane
from ncs_gym.rendering.limits import limit_of, number, reading
from ncs_gym.rendering.scene import Scene

TRACK = theme.STAGE.bottom - 24
# Pixels from the middle to the position's limit; of cart and pole (which are not to the track's scale).
LIMIT, CART, POLE = 244.0, 62.0, 72.0
PIVOT = TRACK - 34.0


class PoleStage:
    """Draws the cart on its track, and the pole between the marks of its largest angle.

    Args:
        plant: Its states are position, speed, angle and angular rate.
    """

    pair = (2, 3)

    def __init__(self, plant: LinearPlant) -> None:
        self._plant = plant
        self._limit, self._lean = limit_of(plant, 0), limit_of(plant, 2)

    def draw_background(self, canvas: Canvas) -> None:
        """Draws the track with its limits."""
        canvas.line([(self._x(-1.15 * self._limit), TRACK), (self._x(1.15 * self._limit), TRACK)], theme.FAINT, 3.0)
        for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
            x = self._x(share * self._limit)
            color = theme.DANGER if abs(share) == 1.0 else theme.FAINT
            canvas.line([(x, TRACK - (22 if abs(share) == 1.0 else 0)), (x, TRACK + 5)], color, 2.0)
            canvas.text(number(share * self._limit) + (" m" if share else ""), (x, TRACK + 14), theme.MUTED, align=0.5)

    def draw(self, canvas: Canvas, scene: Scene) -> None:
        """Draws what moves."""
        position, angle = float(scene.state[0]), float(scene.state[2])
        x = self._x(position)
        if scene.goal is not None and scene.goal.name == "position":
            _draw_flag(canvas, self._x(scene.goal.target))
        for share in (-1.0, 1.0):
            tip = _tip(x, share * self._lean, 1.1)
            canvas.dashed([(x, PIVOT), tip], theme.DANGER, 1.25, dash=4.0)
        _draw_cart(canvas, x)
        canvas.line([(x, PIVOT), _tip(x, angle)], theme.strain(angle / self._lean), 6.0)
        canvas.circle((x, PIVOT), 4.0, theme.INK)
        for i, height, size in ((2, 40.0, theme.LARGE), (1, 19.0, theme.SMALL)):
            self._draw_reading(canvas, x, height, size, i, float(scene.state[i]))
        ghost = self._x(float(scene.estimate[0]))
        canvas.dashed([(ghost, PIVOT), _tip(ghost, float(scene.estimate[2]))], theme.ESTIMATE, 2.0)
        draw_lane(canvas, scene, 130.0, theme.WIDTH - 130.0)

    def _draw_reading(self, canvas: Canvas, x: float, height: float, size: int, index: int, value: float) -> None:
        """Writes a state beside the pole, where there is more room."""
        limit, side = limit_of(self._plant, index), 1.0 if x < theme.WIDTH / 2 else -1.0
        text, place = f"{reading(value, limit)} {self._plant.state_units[index]}", (x + side * 46, PIVOT - height)
        canvas.text(text, place, theme.strain(value / limit), size, align=0.5 - 0.5 * side, bold=True)

    def _x(self, position: float) -> float:
        """Returns where a position is [pixels]."""
        return theme.WIDTH / 2 + LIMIT * float(np.clip(position / self._limit, -1.15, 1.15))


def _tip(x: float, angle: float, length: float = 1.0) -> tuple[float, float]:
    """Returns the end of a pole that leans to the right by an angle [rad]."""
    return x + length * POLE * sin(angle), PIVOT - length * POLE * cos(angle)


def _draw_cart(canvas: Canvas, x: float) -> None:
    canvas.rect(theme.Rect(x - CART / 2, PIVOT - 4, CART, 26), theme.BODYWORK, radius=4)
    for offset in (-18.0, 18.0):
        canvas.circle((x + offset, TRACK - 9), 8.0, theme.INK)
        canvas.circle((x + offset, TRACK - 9), 3.0, theme.FAINT)


def _draw_flag(canvas: Canvas, x: float) -> None:
    canvas.line([(x, TRACK - 2), (x, TRACK - 44)], theme.SAFE, 2.0)
    canvas.polygon([(x, TRACK - 44), (x + 20, TRACK - 37), (x, TRACK - 30)], theme.SAFE)
