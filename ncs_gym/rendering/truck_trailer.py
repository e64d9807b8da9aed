"""The drawing of the truck and its trailer."""

from __future__ import annotations

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import FrameRecord
from ncs_gym.rendering.packet_animation import draw_packets
from ncs_gym.rendering.phase_plane import range_of

# Height of the road in the frame [pixels].
_ROAD = theme.PLANT_VIEW.bottom - 24
# The front of the trailer stands still at this x; the coupling at rest has this length, its limit is this much farther.
_FRONT, _REST_LENGTH, _LIMIT_LENGTH = 192.0, 106.0, 62.0
_TRAILER_LENGTH, _TRUCK_LENGTH = 150.0, 176.0
_AXLE, _WHEEL_RADIUS = _ROAD - 13, 12.0
# A truck farther out than this, in units of the limit, is drawn at the edge of the view.
_MAX_STRETCH = 1.9
# The marks of the road move by this many pixels per meter driven, and are this many pixels apart.
_ROAD_SCALE, _ROAD_MARK_SPACING = 1.5, 56.0


class TruckTrailerDrawing:
    """Draws truck, trailer and coupling, as seen from the trailer; the truck's hitch moves between its limits.

    Args:
        plant: The plant, whose first state is the stretch of the coupling.

    Attributes:
        pair: The states in the phase plane.
    """

    pair = (0, 1)

    def __init__(self, plant: LinearPlant) -> None:
        self._limit = range_of(plant, 0).reach

    def draw_background(self, canvas: Canvas) -> None:
        """Draws the road and the marks of the limits."""
        canvas.line([(0, _ROAD), (theme.WIDTH, _ROAD)], theme.FAINT, 1.5)
        for fraction in (-1.0, 0.0, 1.0):
            x = self._hitch(fraction * self._limit)
            label = theme.tick_label(fraction * self._limit, self._limit) + (" m" if fraction else "")
            canvas.text(label, (x, _ROAD + 13), theme.MUTED, align=0.5)
            if fraction:
                canvas.dashed([(x, _ROAD - 72), (x, _ROAD + 5)], theme.DANGER, 1.5, dash=4.0)
        canvas.line([(self._hitch(-self._limit), _ROAD), (self._hitch(self._limit), _ROAD)], theme.SAFE, 3.0)

    def draw(self, canvas: Canvas, frame: FrameRecord) -> None:
        """Draws everything that moves, the packets included."""
        for x in np.arange(-frame.distance * _ROAD_SCALE % _ROAD_MARK_SPACING, theme.WIDTH, _ROAD_MARK_SPACING):
            canvas.line([(x, _ROAD + 21), (x + 22, _ROAD + 21)], theme.FAINT, 1.5)
        stretch, hitch = float(frame.state[0]), self._hitch(float(frame.state[0]))
        _draw_coupling(canvas, hitch, stretch, self._limit)
        _draw_trailer(canvas)
        _draw_truck(canvas, hitch)
        _draw_truck_outline(canvas, self._hitch(float(frame.estimate[0])))
        sensor, controller = _FRONT - 0.5 * _TRAILER_LENGTH, hitch + 138
        canvas.line([(sensor, _ROAD - 66), (sensor, theme.PACKET_LINE + 8)], theme.FAINT, 1.0)
        canvas.line([(controller, _ROAD - 78), (controller, theme.PACKET_LINE + 8)], theme.FAINT, 1.0)
        draw_packets(canvas, frame, sensor, controller)

    def _hitch(self, stretch: float) -> float:
        return _FRONT + _REST_LENGTH + _LIMIT_LENGTH * float(np.clip(stretch / self._limit, -1.5, _MAX_STRETCH))


def _draw_coupling(canvas: Canvas, hitch: float, stretch: float, limit: float) -> None:
    """Draws a spring that turns red near its limit, and its stretch as a number."""
    color = theme.load_color(stretch / limit)
    y, coils = _AXLE - 12, 7
    xs = np.linspace(_FRONT + 10, hitch - 10, 2 * coils + 1)
    ys = y + 9.0 * np.array([0.0, *([1.0, -1.0] * coils)[:-1], 0.0])
    canvas.line([(_FRONT - 2, y), *zip(xs, ys, strict=True), (hitch + 2, y)], color, 3.0)
    text = theme.value_label(stretch, limit, "m")
    canvas.text(text, (_FRONT + 76, _ROAD - 95), color, theme.LARGE, align=0.5, bold=True)


def _draw_wheels(canvas: Canvas, *xs: float) -> None:
    for x in xs:
        canvas.circle((x, _AXLE), _WHEEL_RADIUS, theme.INK)
        canvas.circle((x, _AXLE), 5.0, theme.FAINT)


def _draw_trailer(canvas: Canvas) -> None:
    left = _FRONT - _TRAILER_LENGTH
    canvas.rect(theme.Rect(left, _ROAD - 66, _TRAILER_LENGTH, 46), theme.CARGO, radius=4)
    for fraction in (0.25, 0.5, 0.75):
        x = left + fraction * _TRAILER_LENGTH
        canvas.line([(x, _ROAD - 62), (x, _ROAD - 25)], theme.CRATE, 1.5)
    canvas.rect(theme.Rect(left, _ROAD - 22, _TRAILER_LENGTH, 6), theme.INK, radius=2)
    _draw_wheels(canvas, left + 28, left + 56, left + _TRAILER_LENGTH - 26)


def _draw_truck_outline(canvas: Canvas, hitch: float) -> None:
    front, top, bottom = hitch + _TRUCK_LENGTH, _ROAD - 82, _ROAD - 14
    corners = [(hitch, bottom), (hitch, top), (front, top), (front, bottom), (hitch, bottom)]
    canvas.dashed(corners, theme.ESTIMATE, 1.75, dash=5.0)


def _draw_truck(canvas: Canvas, hitch: float) -> None:
    canvas.rect(theme.Rect(hitch, _ROAD - 24, _TRUCK_LENGTH, 9), theme.INK, radius=3)
    canvas.rect(theme.Rect(hitch + 8, _ROAD - 52, 84, 28), theme.CRATE, radius=3)
    rear, front = hitch + 100, hitch + _TRUCK_LENGTH
    roof, hood = [(rear, _ROAD - 78), (hitch + 152, _ROAD - 78)], [(hitch + 166, _ROAD - 48), (front, _ROAD - 45)]
    canvas.polygon([*roof, *hood, (front, _ROAD - 16), (rear, _ROAD - 16)], theme.BODYWORK)
    top, bottom = _ROAD - 71, _ROAD - 48
    window = [(hitch + 118, top), (hitch + 148, top), (hitch + 158, bottom), (hitch + 118, bottom)]
    canvas.polygon(window, theme.GLASS)
    _draw_wheels(canvas, hitch + 34, hitch + 62, hitch + 144)
