"""The plant itself, in the upper part of a frame: truck and trailer, cart and pole, or a bar for every state."""

from __future__ import annotations

from math import cos, sin

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.past_inputs import inputs_under_way
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import EpisodeRecord
from ncs_gym.rendering.panel import fill, places_on
from ncs_gym.rendering.phase_plane import ends_of
from ncs_gym.validation import counted

# Height of the road or track in the frame [pixels].
_ROAD = theme.PLANT_VIEW.bottom - 24
# The trailer's front stands still at this x; the coupling at rest has this length, its limit is this much farther, and
# a truck farther out than that many limits is drawn at the edge of the view.
_FRONT, _REST_LENGTH, _LIMIT_LENGTH, _MAX_STRETCH = 192.0, 106.0, 62.0, 1.9
_TRAILER_LENGTH, _TRUCK_LENGTH = 150.0, 176.0
# The marks of the road move by this many pixels per meter driven, and are this many pixels apart.
_ROAD_SCALE, _ROAD_MARK_SPACING = 1.5, 56.0
# Pixels from the middle to the limit of the cart's position, and where a cart beyond it is drawn at most.
_TRACK_LENGTH, _MAX_POSITION = 244.0, 1.15
_PIVOT, _POLE_LENGTH = _ROAD - 34.0, 72.0
# The largest number of bars. They reach so many half ranges from the middle, and have so much space for texts [pixels].
_MAX_BARS, _BAR_REACH, _TEXT_WIDTH = 4, 1.3, 150.0
# A lost packet is drawn for this many more steps, and drifts this many pixels along the line in each of them.
_FADE_STEPS, _DRIFT = 2, 27.0
# Pixels between the sensor and a packet just sent, and between an arriving packet and the controller.
_DEPARTURE_GAP, _ARRIVAL_GAP = 40.0, 22.0
# Of several packets closer together than this only one is labeled, that lost at this step or the oldest [pixels].
_LABEL_SPACING = 100.0


class TruckTrailerDrawing:
    """Draws truck, trailer and coupling, as seen from the trailer; the truck's hitch moves between its limits."""

    def __init__(self, plant: LinearPlant) -> None:
        self.pair, self._limit = (0, 1), float(np.abs(ends_of(plant, 0)).max())

    def draw(self, canvas: Canvas, episode: EpisodeRecord) -> None:
        """Draws the road, what moves on it, and the packets."""
        stretch = float(episode.state[0])
        hitch = self._hitch(stretch)
        self._draw_road(canvas, episode.distance)
        color, coils = theme.load_color(stretch / self._limit), 7
        ys = _ROAD - 25 + 9.0 * np.array([0.0, *([1.0, -1.0] * coils)[:-1], 0.0])
        spring = [*zip(np.linspace(_FRONT + 10, hitch - 10, 2 * coils + 1), ys, strict=True)]
        canvas.line([(_FRONT - 2, ys[0]), *spring, (hitch + 2, ys[0])], color, 3.0)
        text = theme.value_label(stretch, self._limit, "m")
        canvas.text(text, (_FRONT + 76, _ROAD - 95), color, theme.LARGE, align=0.5, bold=True)
        self._draw_vehicles(canvas, hitch)
        rear, front = self._hitch(float(episode.estimate[0])) + np.array([0.0, _TRUCK_LENGTH])
        top, bottom = _ROAD - 82, _ROAD - 14
        corners = [(rear, bottom), (rear, top), (front, top), (front, bottom), (rear, bottom)]
        canvas.dashed(corners, theme.ESTIMATE, 1.75, dash=5.0)
        sensor, controller = _FRONT - 0.5 * _TRAILER_LENGTH, hitch + 138
        for x, height in ((sensor, 66), (controller, 78)):
            canvas.line([(x, _ROAD - height), (x, theme.PACKET_LINE + 8)], theme.FAINT, 1.0)
        _draw_packets(canvas, episode, sensor, controller)

    def _hitch(self, stretch: float) -> float:
        return _FRONT + _REST_LENGTH + _LIMIT_LENGTH * float(np.clip(stretch / self._limit, -1.5, _MAX_STRETCH))

    def _draw_road(self, canvas: Canvas, distance: float) -> None:
        canvas.line([(0, _ROAD), (theme.WIDTH, _ROAD)], theme.FAINT, 1.5)
        for fraction in (-1.0, 0.0, 1.0):
            x = self._hitch(fraction * self._limit)
            label = theme.tick_label(fraction * self._limit, self._limit) + " m" * bool(fraction)
            canvas.text(label, (x, _ROAD + 13), theme.MUTED, align=0.5)
            if fraction:
                canvas.dashed([(x, _ROAD - 72), (x, _ROAD + 5)], theme.DANGER, 1.5, dash=4.0)
        canvas.line([(self._hitch(-self._limit), _ROAD), (self._hitch(self._limit), _ROAD)], theme.SAFE, 3.0)
        for x in np.arange(-distance * _ROAD_SCALE % _ROAD_MARK_SPACING, theme.WIDTH, _ROAD_MARK_SPACING):
            canvas.line([(x, _ROAD + 21), (x + 22, _ROAD + 21)], theme.FAINT, 1.5)

    def _draw_vehicles(self, canvas: Canvas, hitch: float) -> None:
        left, rear, front = _FRONT - _TRAILER_LENGTH, hitch + 100, hitch + _TRUCK_LENGTH
        canvas.rect(theme.Rect(left, _ROAD - 66, _TRAILER_LENGTH, 46), theme.CARGO, radius=4)
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


class CartPoleDrawing:
    """Draws the cart on its track, and the pole between the marks of its largest angle."""

    def __init__(self, plant: LinearPlant) -> None:
        self.pair, self._limits = (2, 3), [float(np.abs(ends_of(plant, index)).max()) for index in range(4)]

    def draw(self, canvas: Canvas, episode: EpisodeRecord) -> None:
        """Draws track, cart, pole, the target's flag and the packets."""
        position, speed, angle, _ = episode.state.tolist()
        limit, top_speed, largest_angle, _ = self._limits
        x = self._x(position)
        canvas.line([(self._x(-9.9 * limit), _ROAD), (self._x(9.9 * limit), _ROAD)], theme.FAINT, 3.0)
        for fraction in (-1.0, -0.5, 0.0, 0.5, 1.0):
            mark, is_end = self._x(fraction * limit), abs(fraction) == 1.0
            color = theme.DANGER if is_end else theme.FAINT
            canvas.line([(mark, _ROAD - 22 * is_end), (mark, _ROAD + 5)], color, 2.0)
            label = theme.tick_label(fraction * limit, limit) + " m" * bool(fraction)
            canvas.text(label, (mark, _ROAD + 14), theme.MUTED, align=0.5)
        if (tracked := episode.tracked) is not None and tracked.name == "position":
            flag = self._x(tracked.target)
            canvas.line([(flag, _ROAD - 2), (flag, _ROAD - 44)], theme.SAFE, 2.0)
            canvas.polygon([(flag, _ROAD - 44), (flag + 20, _ROAD - 37), (flag, _ROAD - 30)], theme.SAFE)
        for sign in (-1.0, 1.0):
            canvas.dashed(_pole(x, sign * largest_angle, 1.1), theme.DANGER, 1.25, dash=4.0)
        canvas.rect(theme.Rect(x - 31, _PIVOT - 4, 62, 26), theme.BODYWORK, radius=4)
        for offset in (-18.0, 18.0):
            canvas.circle((x + offset, _ROAD - 9), 8.0, theme.INK)
            canvas.circle((x + offset, _ROAD - 9), 3.0, theme.FAINT)
        canvas.line(_pole(x, angle), theme.load_color(angle / largest_angle), 6.0)
        canvas.circle((x, _PIVOT), 4.0, theme.INK)
        side = 1.0 if x < theme.WIDTH / 2 else -1.0  # numbers stand on the side of the middle of the frame
        for value, end, unit, height, size in (
            (angle, largest_angle, "rad", 40.0, theme.LARGE),
            (speed, top_speed, "m/s", 19.0, theme.SMALL),
        ):
            text, place = theme.value_label(value, end, unit), (x + side * 46, _PIVOT - height)
            canvas.text(text, place, theme.load_color(value / end), size, align=0.5 - 0.5 * side, bold=True)
        canvas.dashed(_pole(self._x(episode.estimate[0]), float(episode.estimate[2])), theme.ESTIMATE, 2.0)
        _draw_packets(canvas, episode, 130.0, theme.WIDTH - 130.0)

    def _x(self, position: float) -> float:
        load = float(np.clip(position / self._limits[0], -_MAX_POSITION, _MAX_POSITION))
        return theme.WIDTH / 2 + _TRACK_LENGTH * load


def _pole(x: float, angle: float, length: float = 1.0) -> list[tuple[float, float]]:
    """Returns the ends of a pole that leans to the right by an angle [rad]."""
    reach = length * _POLE_LENGTH
    return [(x, _PIVOT), (x + reach * sin(angle), _PIVOT - reach * cos(angle))]


class StateBarsDrawing:
    """Draws the first states that have limits, but for past inputs, as bars between these."""

    def __init__(self, plant: LinearPlant) -> None:
        own = range(plant.n - inputs_under_way(plant))
        limited = [i for i in own if np.isfinite(plant.own_limits[:, i]).any()]
        first, second, *_ = [*dict.fromkeys([*limited, *own]), 0]
        self._plant, self._shown, self.pair = plant, limited[:_MAX_BARS], (min(first, second), max(first, second))
        self._hidden = len(limited) - len(self._shown)

    def draw(self, canvas: Canvas, episode: EpisodeRecord) -> None:
        """Draws the true values as bars, the estimated ones as dashed marks, and the packets."""
        for row, i in enumerate(self._shown):
            y = theme.PACKET_LINE + 29 + 14 * (_MAX_BARS - len(self._shown)) + 28 * row
            self._draw_state(
                canvas, theme.Rect(170, y, 340, 14), i, float(episode.state[i]), float(episode.estimate[i])
            )
        if self._hidden:
            place = theme.WIDTH - 16, theme.PLANT_VIEW.bottom - 9
            canvas.text(f"and {counted(self._hidden, 'more state')}", place, theme.MUTED, align=1.0)
        _draw_packets(canvas, episode, 130.0, theme.WIDTH - 130.0)

    def _draw_state(self, canvas: Canvas, bar: theme.Rect, index: int, value: float, estimate: float) -> None:
        plant, limits = self._plant, self._plant.own_limits[:, index]
        low, high = ends_of(plant, index).tolist()
        reach = 0.5 * (low + high) + 0.5 * _BAR_REACH * (high - low) * np.array([-1.0, 1.0])
        lowest, highest, zero, x, estimated = places_on(bar, reach, *limits, 0.0, value, estimate)
        used, height, half, unit = (
            float(np.max(value / limits)),
            bar.y + 7,
            0.5 * (high - low),
            plant.state_units[index],
        )
        canvas.rect(bar, theme.blend(theme.DANGER_FILL, theme.DANGER, 0.15), radius=3)
        canvas.rect(theme.Rect(lowest, bar.y, highest - lowest, bar.h), theme.PAPER)
        for place in np.array([lowest, highest])[np.isfinite(limits)]:
            canvas.dashed([(place, bar.y - 3), (place, bar.bottom + 3)], theme.DANGER, 1.5, dash=3.0)
        fill(canvas, bar, zero, x, theme.load_color(used))
        canvas.line([(zero, bar.y - 1), (zero, bar.bottom + 1)], theme.MUTED, 1.0)
        canvas.dashed([(estimated, bar.y - 4), (estimated, bar.bottom + 4)], theme.ESTIMATE, 2.0, dash=3.0)
        canvas.text(plant.state_names[index], (bar.x - 10, height), theme.INK, align=1.0, max_width=_TEXT_WIDTH)
        text = theme.value_label(value + float(plant.operating_state[index]), half, unit)
        color = theme.DANGER if used > 1.0 else theme.INK
        canvas.text(text, (bar.right + 10, height), color, bold=used > 1.0, max_width=_TEXT_WIDTH)


def drawing_of(plant: LinearPlant) -> TruckTrailerDrawing | CartPoleDrawing | StateBarsDrawing:
    """Returns the drawing of a plant, which is recognized by the names of its states.

    `draw` draws everything; `pair` are the indices of the states in the phase plane.
    """
    names = tuple(plant.state_names)
    if names == ("coupling stretch", "stretch rate"):
        return TruckTrailerDrawing(plant)
    is_cart = names == ("position", "speed", "angle", "angular rate")
    return CartPoleDrawing(plant) if is_cart else StateBarsDrawing(plant)


def _draw_packets(canvas: Canvas, episode: EpisodeRecord, start: float, end: float) -> None:
    """Draws the line from the sensor at x = start to the controller at x = end, and the packets that travel on it."""
    y, step, middle, labeled = theme.PACKET_LINE, episode.step, 0.5 * (start + end), []
    canvas.dashed([(start, y), (end, y)], theme.FAINT, 1.5, dash=3.0)
    for x, name, side, active in (
        (start, "sensor", -1.0, any(packet.stamp == step for packet in episode.packets)),
        (end, "controller", 1.0, any(packet.arrival == step for packet in episode.packets)),
    ):
        color = theme.ESTIMATE if active else theme.MUTED
        canvas.circle((x, y), 7.0, theme.PAPER)
        canvas.circle((x, y), 7.0, color, width=2.0)
        canvas.circle((x, y), 3.5, color if active else theme.PAPER)
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
                labeled.append(middle)
    for stamp, arrival in episode.packets:
        if arrival is None or arrival < step:
            continue
        age, fraction = step - stamp, (step - stamp) / (arrival - stamp) if arrival > stamp else 1.0
        x = start + _DEPARTURE_GAP + (end - start - _DEPARTURE_GAP - _ARRIVAL_GAP) * fraction
        color = theme.LATE if age else theme.ESTIMATE
        canvas.line([(start + 10, y), (x - 11, y)], theme.blend(color, theme.PAPER, 0.6), 2.5)
        _draw_envelope(canvas, (x, y), color)
        if age and all(abs(x - other) > _LABEL_SPACING for other in labeled):
            canvas.text(f"{counted(age, 'step')} late", (x, y - 18), theme.INK, align=0.5, bold=True)
            labeled.append(x)


def _draw_envelope(canvas: Canvas, center: tuple[float, float], color: theme.Color) -> None:
    x, y = center
    canvas.rect(theme.Rect(x - 11, y - 7.5, 22, 15), color, radius=2.5)
    canvas.line([(x - 9, y - 5), (x, y + 1), (x + 9, y - 5)], theme.PAPER, 1.25)
