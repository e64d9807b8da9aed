"""The plant itself, in the upper part of a frame: truck and trailer, or a bar for every state."""

from __future__ import annotations

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import EpisodeRecord
from ncs_gym.rendering.panel import ROW, draw_bar
from ncs_gym.rendering.phase_plane import ends_of, limited_states

# Height of the road in the frame [pixels].
_ROAD = theme.PLANT_VIEW.bottom - 24
# The trailer's front stands still at this x; the coupling at rest has this length, its limit is this much farther, and
# a truck farther out than that many limits is drawn at the edge of the view.
_FRONT, _REST_LENGTH, _LIMIT_LENGTH, _MAX_STRETCH = 192.0, 106.0, 62.0, 1.9
_TRAILER_LENGTH, _TRUCK_LENGTH = 150.0, 176.0
# The largest number of bars, which reach so many half ranges from the middle.
_MAX_BARS, _BAR_REACH = 4, 1.3
# A lost packet is drawn for this many more steps, and drifts this many pixels along the line in each of them.
_FADE_STEPS, _DRIFT = 2, 27.0
# Pixels between the sensor and a packet just sent, and between an arriving packet and the controller.
_DEPARTURE_GAP, _ARRIVAL_GAP = 40.0, 22.0


class TruckTrailerDrawing:
    """Draws truck, trailer and coupling, as seen from the trailer; the truck's hitch moves between its limits."""

    def __init__(self, plant: LinearPlant) -> None:
        self._limit = float(np.abs(ends_of(plant, 0)).max())

    def draw(self, canvas: Canvas, episode: EpisodeRecord) -> None:
        """Draws the road, what moves on it, and the packets."""
        stretch = float(episode.state[0])
        hitch = self._hitch(stretch)
        canvas.line([(0, _ROAD), (theme.WIDTH, _ROAD)], theme.FAINT, 1.5)
        ends = [(self._hitch(-self._limit), _ROAD), (self._hitch(self._limit), _ROAD)]
        for x, y in ends:
            canvas.dashed([(x, y - 72), (x, y + 5)], theme.DANGER, 1.5, dash=4.0)
        canvas.line(ends, theme.SAFE, 3.0)
        color, coils = theme.load_color(stretch / self._limit), 7
        ys = _ROAD - 25 + 9.0 * np.array([0.0, *([1.0, -1.0] * coils)[:-1], 0.0])
        spring = [*zip(np.linspace(_FRONT + 10, hitch - 10, 2 * coils + 1), ys, strict=True)]
        canvas.line([(_FRONT - 2, ys[0]), *spring, (hitch + 2, ys[0])], color, 3.0)
        text = theme.value_label(stretch, self._limit, "m")
        canvas.text(text, (_FRONT + 76, _ROAD - 95), color, theme.LARGE, align=0.5, bold=True)
        self._draw_vehicles(canvas, hitch)
        believed = theme.Rect(self._hitch(float(episode.estimate[0])), _ROAD - 82, _TRUCK_LENGTH, 68)
        canvas.rect(believed, theme.ESTIMATE, radius=3, width=1.75)
        sensor, controller = _FRONT - 0.5 * _TRAILER_LENGTH, hitch + 138
        for x, height in ((sensor, 66), (controller, 78)):
            canvas.line([(x, _ROAD - height), (x, theme.PACKET_LINE + 8)], theme.FAINT, 1.0)
        _draw_packets(canvas, episode, sensor, controller)

    def _hitch(self, stretch: float) -> float:
        return _FRONT + _REST_LENGTH + _LIMIT_LENGTH * float(np.clip(stretch / self._limit, -1.5, _MAX_STRETCH))

    def _draw_vehicles(self, canvas: Canvas, hitch: float) -> None:
        left, rear, front = _FRONT - _TRAILER_LENGTH, hitch + 100, hitch + _TRUCK_LENGTH
        canvas.rect(theme.Rect(left, _ROAD - 66, _TRAILER_LENGTH, 46), theme.FAINT, radius=4)
        for x in left + _TRAILER_LENGTH * np.array([0.25, 0.5, 0.75]):
            canvas.line([(x, _ROAD - 62), (x, _ROAD - 25)], theme.CRATE, 1.5)
        canvas.rect(theme.Rect(left, _ROAD - 22, _TRAILER_LENGTH, 6), theme.INK, radius=2)
        canvas.rect(theme.Rect(hitch, _ROAD - 24, _TRUCK_LENGTH, 9), theme.INK, radius=3)
        canvas.rect(theme.Rect(hitch + 8, _ROAD - 52, 84, 28), theme.CRATE, radius=3)
        roof, hood = [(rear, _ROAD - 78), (hitch + 152, _ROAD - 78)], [(hitch + 166, _ROAD - 48), (front, _ROAD - 45)]
        canvas.polygon([*roof, *hood, (front, _ROAD - 16), (rear, _ROAD - 16)], theme.BODYWORK)
        window = [(118, 71), (148, 71), (158, 48), (118, 48)]
        canvas.polygon([(hitch + x, _ROAD - height) for x, height in window], theme.GLASS)
        for x in (left + 28, left + 56, left + _TRAILER_LENGTH - 26, hitch + 34, hitch + 62, hitch + 144):
            canvas.circle((x, _ROAD - 13), 12.0, theme.INK)
            canvas.circle((x, _ROAD - 13), 5.0, theme.FAINT)


class StateBarsDrawing:
    """Draws the first states that have limits, but for past inputs, as bars with these limits."""

    def __init__(self, plant: LinearPlant) -> None:
        self._shown = limited_states(plant)[:_MAX_BARS]

    def draw(self, canvas: Canvas, episode: EpisodeRecord) -> None:
        """Draws the true values as bars, the estimated ones as dashed marks, and the packets."""
        y = theme.PACKET_LINE + (34.0 if len(self._shown) > 2 else 55.0)
        for place, i in enumerate(self._shown):
            row, column = divmod(place, 2)
            x = theme.PANEL.x if column else theme.WIDTH - theme.PANEL.right
            self._draw_state(canvas, episode, i, (x, y + ROW * row))
        _draw_packets(canvas, episode, 130.0, theme.WIDTH - 130.0)

    def _draw_state(self, canvas: Canvas, episode: EpisodeRecord, index: int, place: tuple[float, float]) -> None:
        plant, limits, ends = episode.plant, episode.plant.own_limits[:, index], ends_of(episode.plant, index)
        value, estimate = float(episode.state[index]), float(episode.estimate[index])
        used, half = float(np.max(value / limits)), 0.5 * float(ends[1] - ends[0])
        text = theme.value_label(value + float(plant.operating_state[index]), half, plant.state_units[index])
        reach = ends + (_BAR_REACH - 1.0) * half * np.array([-1.0, 1.0])
        colors = theme.DANGER if used > 1.0 else theme.INK, theme.load_color(used)
        name, values = plant.state_names[index], (0.0, value, *limits, estimate)
        bar, (lowest, highest, estimated) = draw_bar(canvas, place, name, text, colors, reach, values)
        for x in np.array([lowest, highest])[np.isfinite(limits)]:
            canvas.dashed([(x, bar.y - 3), (x, bar.bottom + 3)], theme.DANGER, 1.5, dash=3.0)
        canvas.dashed([(estimated, bar.y - 4), (estimated, bar.bottom + 4)], theme.ESTIMATE, 2.0, dash=3.0)


def drawing_of(plant: LinearPlant) -> TruckTrailerDrawing | StateBarsDrawing:
    """Returns the drawing of a plant; the truck is recognized by the names of its states."""
    is_truck = tuple(plant.state_names) == ("coupling stretch", "stretch rate")
    return TruckTrailerDrawing(plant) if is_truck else StateBarsDrawing(plant)


def _draw_packets(canvas: Canvas, episode: EpisodeRecord, start: float, end: float) -> None:
    """Draws the line from the sensor at x = start to the controller at x = end, and the packets that travel on it."""
    y, step, middle = theme.PACKET_LINE, episode.step, 0.5 * (start + end)
    canvas.dashed([(start, y), (end, y)], theme.FAINT, 1.5, dash=3.0)
    for x, name, side, moment in ((start, "sensor", -1.0, "stamp"), (end, "controller", 1.0, "arrival")):
        active = any(getattr(packet, moment) == step for packet in episode.packets)
        canvas.circle((x, y), 7.0, theme.ESTIMATE if active else theme.MUTED)
        canvas.circle((x, y), 3.0 if active else 5.0, theme.PAPER)
        canvas.text(name, (x + 12 * side, y), theme.MUTED, align=0.5 - 0.5 * side)
    age = int(episode.info["measurement_age"])
    canvas.text(f"age {age}", (end + 12, y + 17), theme.LATE_TEXT if age else theme.ESTIMATE, bold=True)
    for stamp, arrival in episode.packets:
        age = step - stamp
        if arrival is None and age <= _FADE_STEPS:
            _draw_envelope(canvas, (middle + _DRIFT * age, y), theme.blend(theme.FAINT, theme.MIST, 0.3 * age))
            for sign in (-8.0, 8.0):
                ends = [(middle + _DRIFT * age - 8, y - sign), (middle + _DRIFT * age + 8, y + sign)]
                canvas.line(ends, theme.blend(theme.DANGER, theme.MIST, 0.3 * age), 3.0)
            if age == 0:
                canvas.text("lost", (middle, y - 18), theme.DANGER, align=0.5, bold=True)
        if arrival is not None and arrival >= step:
            fraction = age / (arrival - stamp) if arrival > stamp else 1.0
            x = start + _DEPARTURE_GAP + (end - start - _DEPARTURE_GAP - _ARRIVAL_GAP) * fraction
            color = theme.LATE if age else theme.ESTIMATE
            canvas.line([(start + 10, y), (x - 11, y)], theme.blend(color, theme.PAPER, 0.6), 2.5)
            _draw_envelope(canvas, (x, y), color)


def _draw_envelope(canvas: Canvas, center: tuple[float, float], color: theme.Color) -> None:
    x, y = center
    canvas.rect(theme.Rect(x - 11, y - 7.5, 22, 15), color, radius=2.5)
    canvas.line([(x - 9, y - 5), (x, y + 1), (x + 9, y - 5)], theme.PAPER, 1.25)
