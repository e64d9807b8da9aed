"""The drawing of the cart and its pole."""

from __future__ import annotations

from math import cos, sin

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import FrameRecord
from ncs_gym.rendering.packet_animation import draw_packets
from ncs_gym.rendering.phase_plane import range_of

# Height of the track in the frame [pixels].
_TRACK = theme.PLANT_VIEW.bottom - 24
# Pixels from the middle to the position's limit, and sizes of cart and pole, which are not to the track's scale.
_LIMIT_LENGTH, _CART_LENGTH, _POLE_LENGTH = 244.0, 62.0, 72.0
_PIVOT = _TRACK - 34.0
# A cart farther out than this, in units of the limit, is drawn at the end of the track.
_MAX_POSITION = 1.15


class CartPoleDrawing:
    """Draws the cart on its track, and the pole between the marks of its largest angle.

    Args:
        plant: The plant, whose states are position, speed, angle and angular rate.

    Attributes:
        pair: The states in the phase plane.
    """

    pair = (2, 3)

    def __init__(self, plant: LinearPlant) -> None:
        self._plant = plant
        self._limit, self._angle_limit = range_of(plant, 0).reach, range_of(plant, 2).reach

    def draw_background(self, canvas: Canvas) -> None:
        """Draws the track with its limits."""
        end = _MAX_POSITION * self._limit
        canvas.line([(self._x(-end), _TRACK), (self._x(end), _TRACK)], theme.FAINT, 3.0)
        for fraction in (-1.0, -0.5, 0.0, 0.5, 1.0):
            x = self._x(fraction * self._limit)
            color, height = (theme.DANGER, 22) if abs(fraction) == 1.0 else (theme.FAINT, 0)
            canvas.line([(x, _TRACK - height), (x, _TRACK + 5)], color, 2.0)
            label = theme.tick_label(fraction * self._limit, self._limit) + (" m" if fraction else "")
            canvas.text(label, (x, _TRACK + 14), theme.MUTED, align=0.5)

    def draw(self, canvas: Canvas, frame: FrameRecord) -> None:
        """Draws everything that moves, the packets included."""
        position, angle = float(frame.state[0]), float(frame.state[2])
        x = self._x(position)
        if frame.tracked is not None and frame.tracked.name == "position":
            _draw_flag(canvas, self._x(frame.tracked.target))
        for sign in (-1.0, 1.0):
            tip = _tip(x, sign * self._angle_limit, 1.1)
            canvas.dashed([(x, _PIVOT), tip], theme.DANGER, 1.25, dash=4.0)
        _draw_cart(canvas, x)
        canvas.line([(x, _PIVOT), _tip(x, angle)], theme.load_color(angle / self._angle_limit), 6.0)
        canvas.circle((x, _PIVOT), 4.0, theme.INK)
        for i, height, size in ((2, 40.0, theme.LARGE), (1, 19.0, theme.SMALL)):
            self._draw_value(canvas, x, height, size, i, float(frame.state[i]))
        estimated = self._x(float(frame.estimate[0]))
        canvas.dashed([(estimated, _PIVOT), _tip(estimated, float(frame.estimate[2]))], theme.ESTIMATE, 2.0)
        draw_packets(canvas, frame, 130.0, theme.WIDTH - 130.0)

    def _draw_value(self, canvas: Canvas, x: float, height: float, size: int, index: int, value: float) -> None:
        """Writes a state beside the pole, on the side of the middle of the frame."""
        limit, side = range_of(self._plant, index).reach, 1.0 if x < theme.WIDTH / 2 else -1.0
        text = theme.value_label(value, limit, self._plant.state_units[index])
        place = x + side * 46, _PIVOT - height
        canvas.text(text, place, theme.load_color(value / limit), size, align=0.5 - 0.5 * side, bold=True)

    def _x(self, position: float) -> float:
        return theme.WIDTH / 2 + _LIMIT_LENGTH * float(np.clip(position / self._limit, -_MAX_POSITION, _MAX_POSITION))


def _tip(x: float, angle: float, length: float = 1.0) -> tuple[float, float]:
    """Returns the end of a pole that leans to the right by an angle [rad]."""
    return x + length * _POLE_LENGTH * sin(angle), _PIVOT - length * _POLE_LENGTH * cos(angle)


def _draw_cart(canvas: Canvas, x: float) -> None:
    canvas.rect(theme.Rect(x - _CART_LENGTH / 2, _PIVOT - 4, _CART_LENGTH, 26), theme.BODYWORK, radius=4)
    for offset in (-18.0, 18.0):
        canvas.circle((x + offset, _TRACK - 9), 8.0, theme.INK)
        canvas.circle((x + offset, _TRACK - 9), 3.0, theme.FAINT)


def _draw_flag(canvas: Canvas, x: float) -> None:
    canvas.line([(x, _TRACK - 2), (x, _TRACK - 44)], theme.SAFE, 2.0)
    canvas.polygon([(x, _TRACK - 44), (x + 20, _TRACK - 37), (x, _TRACK - 30)], theme.SAFE)
