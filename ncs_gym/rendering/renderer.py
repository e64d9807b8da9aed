"""Draws the frames of an environment: the plant, the phase plane, inputs and texts; shows a window."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil, log10
from typing import Any

import numpy as np

from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.episode_record import (
    RECENT_STEPS,
    Annotation,
    ConvexSet,
    EpisodeRecord,
    TrackedOutput,
    note_of,
    sent_at,
)
from ncs_gym.rendering.theme import Canvas
from ncs_gym.tasks import Task
from ncs_gym.validation import counted

# The axes reach this far, in units of half their range; a state farther out is drawn so many pixels inside the border.
_AXIS_REACH, _BORDER = 1.5, 7.0
# No line ends farther out than this, because pygame takes long to draw very long lines [pixels].
_MAX_COORDINATE = 2000.0
# What has no end reaches this far, in units of half the range.
_FAR = 10.0


def ends_of(plant: LinearPlant, index: int) -> np.ndarray:
    """Returns the lowest and the highest value of the axis of a state, shape (2,).

    These are the limits of the state alone. An open end is as far as the state reaches in the ellipsoid inside the box,
    or as inputs push it within `RECENT_STEPS` steps if that is less.
    """
    reach, pushed, effect = float(plant.half_widths[index]), 0.0, plant.B
    for _ in range(RECENT_STEPS):
        pushed += float(np.abs(effect[index]) @ plant.largest_input)
        effect = plant.A @ effect
    reach = min(reach, pushed) if pushed > 0.0 else reach
    ends = plant.own_limits[:, index]
    return np.where(np.isfinite(ends), ends, [-reach, reach])


def limited_states(plant: LinearPlant) -> list[int]:
    """Returns the indices of the states with limits of their own, but for past inputs."""
    return [i for i in range(plant.n - plant.past) if np.isfinite(plant.own_limits[:, i]).any()]


class PhasePlane:
    """Draws the last two states with limits, or the only state, beside past inputs, above the time.

    Args:
        plant: The plant, which gives limits, names and units.
    """

    def __init__(self, plant: LinearPlant) -> None:
        own, limited = plant.n - plant.past, limited_states(plant)
        chosen, self._is_timed = sorted([*set(range(own)).difference(limited), *limited][-2:]), own == 1
        self._axes = np.eye(2, plant.n, k=-1) if self._is_timed else np.eye(plant.n)[chosen]
        time = [("time", "steps", np.array([-RECENT_STEPS, 0.0]), np.array([-np.inf, np.inf]))] * self._is_timed
        about = time + [
            (plant.state_names[i], plant.state_units[i], ends_of(plant, i), plant.own_limits[:, i]) for i in chosen
        ]
        self._titles = [f"{name} [{theme.unit_label(unit)}]" if unit else name for name, unit, *_ in about]
        low, high = np.transpose([ends for *_, ends, _ in about])
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)
        self._offset, limits = self._axes @ plant.operating_state, np.array([limits for *_, limits in about])
        far = self._middle[:, None] + _FAR * self._half[:, None] * [-1.0, 1.0]
        (left, right), (bottom, top) = np.where(np.isfinite(limits), limits, far)
        self._box = np.array([(left, bottom), (right, bottom), (right, top), (left, top)])
        rect, half = theme.PLANE, np.array([theme.PLANE.w, -theme.PLANE.h]) / 2.0
        self._center, self._scale = np.array([rect.x, rect.y]) + np.abs(half), half / (_AXIS_REACH * self._half)
        self._outlined: tuple[object, np.ndarray] = None, np.empty((0, 2))

    def pixels_of(self, points: np.ndarray) -> np.ndarray:
        """Returns where points of the plane are in the frame, shape (k, 2), those far away nearer [pixels]."""
        moved = self._scale * (points - self._middle)
        farthest = np.abs(moved).max(axis=1, keepdims=True, initial=1.0)
        return self._center + np.minimum(1.0, _MAX_COORDINATE / farthest) * moved

    def draw(self, canvas: Canvas, episode: EpisodeRecord) -> None:
        """Draws sets and axes, and what moves: the error bound, path, stored plan, estimate and true state."""
        rect, count, (truth, estimate) = theme.PLANE, len(episode.path), self._points([episode.state, episode.estimate])
        canvas.rect(rect, theme.DANGER_FILL)
        canvas.clip(rect)
        self._draw_sets(canvas, episode.annotation)
        ellipse = self.pixels_of(estimate + self._outline(Ellipsoid(episode.info["error_shape"])))
        canvas.polygon(ellipse, theme.ERROR_FILL)
        canvas.line([*ellipse, ellipse[0]], theme.LATE, 1.0)
        path = self.pixels_of(self._points(episode.path, np.arange(1 - count, 1)))
        for i in range(1, count):
            canvas.line(path[i - 1 : i + 1], theme.blend(theme.FAINT, theme.INK, i / count), 1.5)
        for point in path[np.array(episode.interventions)]:
            canvas.circle(point, 3.0, theme.SHIELD)
        plan = episode.planned_states
        ahead = self.pixels_of(self._points(plan, np.arange(len(plan))))
        if len(plan) > 1:
            canvas.dashed(ahead, theme.PLAN, 1.5, dash=2.0)
        for point in ahead[1:]:
            canvas.circle(point, 2.5, theme.PLAN)
        inside = np.array([rect.x, rect.y]) + _BORDER, np.array([rect.right, rect.bottom]) - _BORDER
        marks = np.clip(self.pixels_of(np.array([truth, estimate])), *inside)
        canvas.circle(marks[1], 5.0, theme.ESTIMATE, width=1.5)
        canvas.circle(marks[0], 4.0, theme.DANGER if episode.violated else theme.INK)
        if episode.violated:
            canvas.circle(marks[0], 9.0, theme.DANGER, width=2.0)
        canvas.clip(None)
        self._draw_axes(canvas)

    def _points(self, states: object, time: object = 0) -> np.ndarray:
        """Returns where states, shape (k, n), at some times [steps] are in the plane, shape (k, 2)."""
        points = np.asarray(states) @ self._axes.T
        points[:, 0] += np.asarray(time) * self._is_timed
        return points

    def _outline(self, bounded: ConvexSet, far: float = 0.0) -> np.ndarray:
        """Returns where tangents, every 3 degrees, of a set's projection on the plane meet, shape (120, 2)."""
        angles, turn = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False), 2.0 * np.pi / 120
        normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        heights = bounded.support(normals / self._half @ self._axes) + far * np.abs(normals[:, 0])
        along = (np.roll(heights, -1) - heights * np.cos(turn)) / np.sin(turn)
        return self._half * (heights[:, None] * normals + along[:, None] * normals[:, ::-1] * [-1.0, 1.0])

    def _draw_sets(self, canvas: Canvas, note: Annotation | None) -> None:
        rect, box = theme.PLANE, self.pixels_of(self._box)
        canvas.polygon(box, theme.PAPER)
        if note is not None and self._outlined[0] is not note.safe_set:
            far = _FAR * self._is_timed  # at all times
            self._outlined = note.safe_set, self.pixels_of(self._outline(note.safe_set, far))
        if note is not None:
            canvas.polygon(self._outlined[1], theme.SAFE_FILL)
        for fraction in (-1.0, -0.5, 0.0, 0.5, 1.0):
            ((x, y),) = self.pixels_of((self._middle + fraction * self._half)[None])
            color = theme.GRID if fraction else theme.FAINT
            canvas.line([(x, rect.y), (x, rect.bottom)], color, 0.5)
            canvas.line([(rect.x, y), (rect.right, y)], color, 0.5)
        if note is not None:
            canvas.line([*self._outlined[1], self._outlined[1][0]], theme.SAFE, 2.0)
        canvas.dashed([*box, box[0]], theme.DANGER, 1.5)

    def _draw_axes(self, canvas: Canvas) -> None:
        rect = theme.PLANE
        canvas.rect(rect, theme.FAINT, width=0.5)
        for fraction in (-1.0, 0.0, 1.0):
            value = self._middle + fraction * self._half
            ((x, y),), (across, up) = self.pixels_of(value[None]), value + self._offset
            canvas.text(theme.tick_label(across, self._half[0]), (x, rect.bottom + 11), theme.MUTED, align=0.5)
            canvas.text(theme.tick_label(up, self._half[1]), (rect.x - 6, y), theme.MUTED, align=1.0)
        place, beside = (self._center[0], rect.bottom + 30), (rect.x - 62, self._center[1])
        canvas.text(self._titles[0], place, theme.INK, align=0.5, max_width=rect.w)
        canvas.text(self._titles[1], beside, theme.INK, upright=True, max_width=rect.h)


# The largest number of inputs that are drawn, and the height of a row [pixels].
_MAX_INPUTS, ROW = 3, 42.0


def draw_header(canvas: Canvas, episode: EpisodeRecord) -> None:
    """Draws step and time at the left, and the shield and the violations at the right."""
    y, dt = theme.HEADER.h / 2, episode.plant.dt
    decimals = 0 if dt == int(dt) else min(max(1, ceil(-log10(dt))), 6)
    canvas.text(f"step {episode.step}", (16, y), theme.INK, theme.BODY, bold=True)
    canvas.text(f"{episode.step * dt:.{decimals}f} s", (172, y), theme.MUTED, theme.BODY, align=1.0)
    count = int(episode.info["episode_violations"])
    text = counted(count, "violation") if count else "no violation"
    color, fill = (theme.DANGER, theme.DANGER_FILL) if count else (theme.SAFE, theme.SAFE_FILL)
    left = _draw_label(canvas, theme.WIDTH - 16, text, color, fill, filled=episode.violated)
    color, fill = (theme.SHIELD, theme.SHIELD_FILL) if episode.annotation else (theme.INK, theme.GRID)
    _draw_label(canvas, left - 10, _shield_text(episode.annotation), color, fill, filled=episode.intervened)


def draw_panel(canvas: Canvas, episode: EpisodeRecord) -> None:
    """Draws inputs, tracked output and the legend."""
    inputs = min(episode.plant.m, _MAX_INPUTS)
    for i in range(inputs):
        _draw_input(canvas, episode, i, theme.PANEL.y + ROW * i)
    if (tracked := episode.tracked) is not None:
        _draw_tracked_output(canvas, tracked, theme.PANEL.y + ROW * inputs)
    if episode.info.get("downlink_broken"):
        canvas.text("downlink broken: zero input", (theme.PANEL.x, 412), theme.DANGER, bold=True)
    _draw_legend(canvas, episode.annotation)


def _shield_text(note: Annotation | None) -> str:
    if note is None:
        return "no shield"
    count = f"{note.interventions}\N{MULTIPLICATION SIGN}"
    if not note.protects:
        return f"shield only watches: would act {count}"
    return f"SHIELD ACTS {count}" if note.intervened else f"shield ({note.label}): acted {count}"


def _draw_label(
    canvas: Canvas, right: float, text: str, color: theme.Color, fill: theme.Color, *, filled: bool
) -> float:
    """Draws a label of the header that ends at `right`; returns where it begins."""
    width = canvas.text_width(text, theme.BODY, bold=True) + 22
    canvas.rect(theme.Rect(right - width, 7, width, theme.HEADER.h - 14), color if filled else fill, radius=13)
    place = right - width + 11, theme.HEADER.h / 2
    canvas.text(text, place, theme.PAPER if filled else color, theme.BODY, bold=True)
    return right - width


def draw_bar(
    canvas: Canvas,
    place: tuple[float, float],
    name: str,
    text: str,
    colors: tuple[theme.Color, theme.Color],
    ends: np.ndarray,
    values: Sequence[float],
) -> tuple[theme.Rect, list[float]]:
    """Draws a row at a place, its upper left corner: name, text, and below a bar from a zero to a value.

    `colors` are those of text and bar, `ends` the values at both ends of the bar, `values` the zero, the value and
    others. Returns the bar's rectangle and where the others are on it, or its end if they are beyond [pixels].
    """
    x, y = place
    width = canvas.text(text, (x + theme.PANEL.w, y + 6), colors[0], align=1.0, bold=True)
    canvas.text(name, (x, y + 6), theme.INK, max_width=theme.PANEL.w - width - 8)
    bar = theme.Rect(x, y + 18, theme.PANEL.w, 12)
    canvas.rect(bar, theme.GRID, radius=4)
    loads = np.clip((np.array(values) - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)
    zero, end, *others = (bar.x + 6 + (bar.w - 12) * loads).tolist()
    canvas.rect(theme.Rect(min(zero, end), bar.y + 2, abs(end - zero), bar.h - 4), colors[1])
    canvas.line([(zero, bar.y - 2), (zero, bar.bottom + 2)], theme.MUTED, 1.0)
    return bar, others


def _draw_input(canvas: Canvas, episode: EpisodeRecord, index: int, y: float) -> None:
    """Draws an input between its limits; where the shield acts, also an arrow from the proposed input."""
    plant, info, note = episode.plant, episode.info, episode.annotation
    limit, value = float(plant.largest_input[index]), float(info["input"][index])
    color = theme.SHIELD if episode.intervened else theme.STEEL
    text = theme.value_label(value + float(plant.operating_input[index]), limit, plant.input_units[index])
    proposed = None if note is None or not note.intervened else note.proposed
    arrow = (
        [] if proposed is None else [proposed[index], episode.info.get("input_committed", episode.info["input"])[index]]
    )
    place, ends, values = (theme.PANEL.x, y), plant.input_ends[:, index], [0.0, value, *arrow]
    bar, arrow = draw_bar(canvas, place, plant.input_names[index], text, (color, color), ends, values)
    if not arrow:
        return
    (start, end), height, side = arrow, bar.y + bar.h / 2, np.sign(arrow[1] - arrow[0])
    canvas.circle((start, height), 5.0, theme.PAPER)
    canvas.circle((start, height), 5.0, theme.SHIELD, width=2.0)
    if abs(end - start) > 14:
        canvas.line([(start + 6 * side, height), (end - 8 * side, height)], theme.SHIELD, 2.0)
        canvas.polygon([(end, height), (end - 10 * side, height - 6), (end - 10 * side, height + 6)], theme.SHIELD)


def _draw_tracked_output(canvas: Canvas, tracked: TrackedOutput, y: float) -> None:
    low, high = tracked.low, tracked.high
    numbers = [theme.value_label(value, max(abs(low), abs(high))).removeprefix("+") for value in tracked[2:4]]
    text = f"{numbers[0]} \N{RIGHTWARDS ARROW} {numbers[1]} {theme.unit_label(tracked.unit)}".strip()
    place, colors, values = (theme.PANEL.x, y), (theme.SAFE, theme.STEEL), (max(low, 0.0), *tracked[2:4])
    bar, (target,) = draw_bar(canvas, place, f"{tracked.name}, target", text, colors, np.array([low, high]), values)
    canvas.line([(target, bar.y - 2), (target, bar.bottom + 2)], theme.SAFE, 3.0)
    canvas.polygon([(target, bar.y + 4), (target - 5, bar.y - 3), (target + 5, bar.y - 3)], theme.SAFE)


def _draw_legend(canvas: Canvas, note: Annotation | None) -> None:
    marks = [("true state", theme.INK, 0.0), ("estimate", theme.ESTIMATE, 1.5), ("error bound", theme.LATE, 1.5)]
    if note is not None:
        marks += [("safe set", theme.SAFE, 2.0), ("shield acted", theme.SHIELD, 0.0)]
        marks += [("stored plan", theme.PLAN, 0.0)] * (note.plan is not None)
    for i, (name, color, width) in enumerate(marks):
        x, y = theme.PANEL.x + 7 + 143 * (i // 3), theme.PANEL.bottom - 42 + 17 * (i % 3)
        canvas.circle((x, y), 4.0 + 0.5 * width, color, width=width)
        canvas.text(name, (x + 14, y), theme.INK)


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


class Renderer:
    """Everything an environment with a render mode needs for its pictures; pygame is imported for the first frame.

    Copies and pickles of it leave out surfaces and window. Drawing raises `gymnasium.error.DependencyNotInstalled` if
    pygame is missing.

    Args:
        plant: The plant that is drawn.
        task: The task, whose tracked output is drawn.
        render_mode: "human" shows every recorded step in a window; "rgb_array" draws only when `render` is called.
        fps: Frames per second of the window.

    Attributes:
        episode: What the present frame shows, as data.
        scale: Pixels of a frame per unit of its layout of 640 by 480; 2 is sharp on dense screens.
    """

    def __init__(self, plant: LinearPlant, task: Task, render_mode: str, fps: int) -> None:
        self._is_shown, self._fps, self.scale = render_mode == "human", fps, 1
        self.episode, self._drawing = EpisodeRecord(plant, task), drawing_of(plant)
        self._plane = PhasePlane(plant)
        self._canvas: Canvas | None = None

    def begin(self, info: Mapping[str, Any], task_state: Any, guard: Any) -> None:
        """Starts an episode, with the info that `reset` returns, the state of the task, and the guard or None."""
        self.episode.begin(info, task_state, note_of(guard, info))
        self._show()

    def record(self, info: Mapping[str, Any], task_state: Any, loop: Any, guard: Any) -> None:
        """Adds a step, with its info, and task, loop and guard after it."""
        self.episode.add(info, task_state, sent_at(loop.steps, loop.network, loop.received), note_of(guard, info))
        self._show()

    def render(self) -> np.ndarray | None:
        """Returns the present frame, shape (height, width, 3), uint8; in mode "human" shows it and returns None."""
        return self._show() if self._is_shown else self._draw().pixels()

    def close(self) -> None:
        """Closes the window; the next frame opens it again."""
        if self._canvas is not None:
            self._canvas.close()
        self._canvas = None

    def _show(self) -> None:
        if self._is_shown:
            self._draw().show("ncs-gym", self._fps)

    def _draw(self) -> Canvas:
        episode, canvas = self.episode, self._canvas or Canvas(self.scale)
        self._canvas = canvas
        canvas.rect(theme.Rect(0, 0, theme.WIDTH, theme.HEIGHT), theme.PAPER)
        calm = theme.SHIELD_FILL if episode.intervened else theme.MIST
        canvas.rect(theme.PLANT_VIEW, theme.DANGER_FILL if episode.violated else calm)
        self._drawing.draw(canvas, episode)
        draw_header(canvas, episode)
        self._plane.draw(canvas, episode)
        draw_panel(canvas, episode)
        return canvas

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_canvas": None}
