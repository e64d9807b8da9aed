"""The phase plane: safe box, safe set, error bound and recent path in two coordinates, or of one state against time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import RECENT_STEPS, FrameRecord, OutlinedSet
from ncs_gym.rendering.panel import draw_plan
from ncs_gym.uncertainty.ellipsoid import Ellipsoid

# The axes reach this far, in units of the limits.
_AXIS_REACH = 1.5
# States farther out are drawn this many pixels inside the border.
_BORDER = 7.0
# No line ends farther out than this, because pygame takes long to draw very long lines [pixels].
_MAX_COORDINATE = 2000.0
# Corners of a polygon that lies outside all axes, in units of the limits.
_FAR = 10.0


class Range(NamedTuple):
    """What the axis of a state is about.

    Attributes:
        low, high: The limits of the state; where an end is open, or the safe box has none, how far it reaches in the
            ellipsoid inside the box, or how far inputs push it within `RECENT_STEPS` steps if that is less.
    """

    low: float
    high: float

    @property
    def middle(self) -> float:
        """The middle of the axis."""
        return 0.5 * (self.low + self.high)

    @property
    def half(self) -> float:
        """Half the range."""
        return 0.5 * (self.high - self.low)

    @property
    def reach(self) -> float:
        """The largest absolute value."""
        return max(-self.low, self.high)


def range_of(plant: LinearPlant, index: int) -> Range:
    """Returns the range of a state: between the closest limits of it alone."""
    (low, high), reach = plant.own_limits[:, index].tolist(), float(plant.half_widths[index])
    if not np.isfinite([low, high]).all():
        pushed, effect = 0.0, plant.B
        for _ in range(RECENT_STEPS):
            pushed += float(np.abs(effect[index]) @ plant.largest_input)
            effect = plant.A @ effect
        reach = min(reach, pushed) if pushed > 0.0 else reach
    return Range(low if np.isfinite(low) else -reach, high if np.isfinite(high) else reach)


class PhasePlane:
    """Draws two coordinates of the state.

    Args:
        plant: The plant, which gives limits, names and units.
        pair: Indices of the horizontal and the vertical coordinate.
        rect: Where the axes are in the frame.
    """

    def __init__(self, plant: LinearPlant, pair: tuple[int, int], rect: theme.Rect) -> None:
        self._plant, self._pair, self._rect = plant, pair, rect
        ranges = [range_of(plant, index) for index in pair]
        self._middle, self._half = np.array([[each.middle, each.half] for each in ranges]).T
        half = np.array([rect.w, -rect.h]) / 2.0
        self._center = np.array([rect.x, rect.y]) + np.abs(half)
        self._scale = half / (_AXIS_REACH * self._half)

    def pixels_of(self, points: np.ndarray) -> np.ndarray:
        """Returns where points in the two coordinates, shape (k, 2), are in the frame, shape (k, 2) [pixels]."""
        return self._center + self._scale * (points - self._middle)

    def draw_background(self, canvas: Canvas, safe_set: Ellipsoid | OutlinedSet | None) -> None:
        """Draws what does not move: the box, the safe set, ticks and titles."""
        rect = self._rect
        canvas.rect(rect, theme.DANGER_FILL)
        canvas.clip(rect)
        box = self.pixels_of(_box_corners(self._plant, self._pair))
        canvas.polygon(box, theme.PAPER)
        if safe_set is not None:
            outline = self.pixels_of(self._outline(safe_set))
            canvas.polygon(outline, theme.SAFE_FILL)
        for fraction in (-1.0, -0.5, 0.0, 0.5, 1.0):
            x, y = self.pixels_of(self._middle + fraction * self._half)
            color = theme.FAINT if fraction == 0.0 else theme.GRID
            canvas.line([(x, rect.y), (x, rect.bottom)], color, 0.5)
            canvas.line([(rect.x, y), (rect.right, y)], color, 0.5)
        if safe_set is not None:
            canvas.line([*outline, outline[0]], theme.SAFE, 2.0)
        canvas.dashed([*box, box[0]], theme.DANGER, 1.5)
        canvas.clip(None)
        canvas.rect(rect, theme.FAINT, width=0.5)
        self._draw_axes(canvas)

    def draw(self, canvas: Canvas, frame: FrameRecord) -> None:
        """Draws what moves: the error bound, the path, the stored plan, the estimate and the true state."""
        canvas.clip(self._rect)
        pair = list(self._pair)
        ellipse = self._drawable(frame.estimate[pair] + self._projection(frame.error_shape))
        canvas.polygon(ellipse, theme.ERROR_FILL)
        canvas.line([*ellipse, ellipse[0]], theme.LATE, 1.0)
        self._draw_path(canvas, frame)
        draw_plan(canvas, [*self._drawable(frame.planned_states[:, pair])])
        canvas.circle(self._inside(frame.estimate[pair]), 5.0, theme.ESTIMATE, width=1.5)
        truth = self._inside(frame.state[pair])
        canvas.circle(truth, 4.0, theme.DANGER if frame.violated else theme.INK)
        if frame.violated:
            canvas.circle(truth, 9.0, theme.DANGER, width=2.0)
        canvas.clip(None)
        if np.any(np.abs(frame.state[pair] - self._middle) > _AXIS_REACH * self._half):
            _say_outside(canvas, self._rect, truth[1])

    def _draw_path(self, canvas: Canvas, frame: FrameRecord) -> None:
        points = [*self._drawable(frame.path[:, list(self._pair)])]
        count = len(points)
        for i in range(1, count):
            color = theme.blend(theme.FAINT, theme.INK, i / count)
            canvas.line(points[i - 1 : i + 1], color, 1.5)
        _draw_interventions(canvas, points, frame)

    def _outline(self, safe_set: Ellipsoid | OutlinedSet) -> np.ndarray:
        if isinstance(safe_set, Ellipsoid):
            return self._projection(safe_set.shape_matrix)
        return safe_set.outline(self._pair)

    def _projection(self, shape: np.ndarray) -> np.ndarray:
        """Returns points around an ellipsoid's projection onto the two coordinates, shape (k, 2)."""
        return _ellipse_points(shape[np.ix_(self._pair, self._pair)])

    def _drawable(self, points: np.ndarray) -> np.ndarray:
        """Returns where points, shape (k, 2), are in the frame, those far outside nearer in the same direction."""
        moved = self.pixels_of(points) - self._center
        farthest = np.abs(moved).max(axis=1, keepdims=True, initial=1.0)
        return self._center + np.minimum(1.0, _MAX_COORDINATE / farthest) * moved

    def _inside(self, point: np.ndarray) -> np.ndarray:
        """Returns where a point is in the frame, moved to the border if it is outside the axes [pixels]."""
        rect = self._rect
        low, high = (rect.x + _BORDER, rect.y + _BORDER), (rect.right - _BORDER, rect.bottom - _BORDER)
        return np.clip(self.pixels_of(point), low, high)

    def _draw_axes(self, canvas: Canvas) -> None:
        rect, plant, (i, j) = self._rect, self._plant, self._pair
        for fraction in (-1.0, 0.0, 1.0):
            value = self._middle + fraction * self._half
            x, y = self.pixels_of(value)
            value = value + plant.operating_state[[i, j]]
            canvas.text(theme.tick_label(value[0], self._half[0]), (x, rect.bottom + 11), theme.MUTED, align=0.5)
            canvas.text(theme.tick_label(value[1], self._half[1]), (rect.x - 6, y), theme.MUTED, align=1.0)
        _draw_titles(
            canvas,
            rect,
            _axis_title(plant.state_names[i], plant.state_units[i]),
            _axis_title(plant.state_names[j], plant.state_units[j]),
        )


class TimePlot:
    """Draws the only state of a plant against time, in place of the phase plane.

    Args:
        plant: A plant with one state, perhaps beside past inputs.
        rect: Where the axes are in the frame.
    """

    def __init__(self, plant: LinearPlant, rect: theme.Rect) -> None:
        self._plant, self._rect, self._range = plant, rect, range_of(plant, 0)

    def draw_background(self, canvas: Canvas, safe_set: Ellipsoid | OutlinedSet | None) -> None:
        """Draws what does not move: limits, the safe set, ticks and titles."""
        rect = self._rect
        canvas.rect(rect, theme.DANGER_FILL)
        self._fill_band(canvas, *self._range, theme.PAPER)
        if safe_set is not None:
            axis = np.eye(self._plant.n)[:1]
            high, low = (sign * float(np.ravel(safe_set.support(sign * axis))[0]) for sign in (1.0, -1.0))
            self._fill_band(canvas, low, high, theme.SAFE_FILL)
            for y in (self._y(high), self._y(low)):
                canvas.line([(rect.x, y), (rect.right, y)], theme.SAFE, 2.0)
        for fraction in (-1.0, 0.0, 1.0):
            value = self._range.middle + fraction * self._range.half
            y = self._y(value)
            text = theme.tick_label(float(self._plant.operating_state[0]) + value, self._range.half)
            canvas.text(text, (rect.x - 6, y), theme.MUTED, align=1.0)
            ends = [(rect.x, y), (rect.right, y)]
            if fraction:
                canvas.dashed(ends, theme.DANGER, 1.5)
            else:
                canvas.line(ends, theme.FAINT, 0.5)
        canvas.rect(rect, theme.FAINT, width=0.5)
        for age in (0, RECENT_STEPS // 2, RECENT_STEPS):
            canvas.text(theme.tick_label(-age, RECENT_STEPS), (self._x(age), rect.bottom + 11), theme.MUTED, align=0.5)
        title = _axis_title(self._plant.state_names[0], self._plant.state_units[0])
        _draw_titles(canvas, rect, "time [steps]", title)

    def draw(self, canvas: Canvas, frame: FrameRecord) -> None:
        """Draws what moves: the path, the error bound as a bar, the estimate and the true state."""
        canvas.clip(self._rect)
        count = len(frame.path)
        points = [(self._x(count - 1 - i), self._height(float(frame.path[i, 0]))) for i in range(count)]
        if count > 1:
            canvas.line(points, theme.MUTED, 1.5)
        _draw_interventions(canvas, points, frame)
        truth = self._y(float(frame.state[0]))
        x, estimate, bound = self._x(0), float(frame.estimate[0]), float(np.sqrt(frame.error_shape[0, 0]))
        canvas.line([(x, self._y(estimate - bound)), (x, self._y(estimate + bound))], theme.LATE, 3.0)
        canvas.circle((x, self._y(estimate)), 5.0, theme.ESTIMATE, width=1.5)
        canvas.circle((x, truth), 4.0, theme.DANGER if frame.violated else theme.INK)
        canvas.clip(None)
        if abs(float(frame.state[0]) - self._range.middle) > _AXIS_REACH * self._range.half:
            _say_outside(canvas, self._rect, truth)

    def _fill_band(self, canvas: Canvas, low: float, high: float, color: theme.Color) -> None:
        top, bottom = self._y(high), self._y(low)
        canvas.rect(theme.Rect(self._rect.x, top, self._rect.w, bottom - top), color)

    def _x(self, age: float) -> float:
        return self._rect.right - 12 - (self._rect.w - 24) * age / RECENT_STEPS

    def _height(self, value: float) -> float:
        """Returns where a value is, above or below the frame if it is outside the axes, but not far [pixels]."""
        half = self._rect.h / 2
        load = (value - self._range.middle) / (_AXIS_REACH * self._range.half)
        return self._rect.y + half - float(np.clip((half - 2) * load, -_MAX_COORDINATE, _MAX_COORDINATE))

    def _y(self, value: float) -> float:
        """Returns where a value is, at the border if it is outside the axes [pixels]."""
        return float(np.clip(self._height(value), self._rect.y + 2, self._rect.bottom - 2))


def _say_outside(canvas: Canvas, rect: theme.Rect, y: float) -> None:
    """Says that the state is outside the axes, on the side where its mark at height y is not."""
    place = rect.x + rect.w / 2, rect.y + 12 if y > rect.y + rect.h / 2 else rect.bottom - 12
    canvas.text("state outside the axes", place, theme.DANGER, align=0.5, bold=True)


def _axis_title(name: str, unit: str) -> str:
    return f"{name} [{theme.unit_label(unit)}]" if unit else name


def _draw_titles(canvas: Canvas, rect: theme.Rect, horizontal: str, vertical: str) -> None:
    canvas.text(horizontal, (rect.x + rect.w / 2, rect.bottom + 30), theme.INK, align=0.5, max_width=rect.w)
    canvas.text(vertical, (rect.x - 62, rect.y + rect.h / 2), theme.INK, upright=True, max_width=rect.h)


def _draw_interventions(canvas: Canvas, points: list, frame: FrameRecord) -> None:
    for point, intervened in zip(points, frame.interventions, strict=True):
        if intervened:
            canvas.circle(point, 3.0, theme.SHIELD)


def _box_corners(plant: LinearPlant, pair: tuple[int, int]) -> np.ndarray:
    """Returns the corners, shape (k, 2), of what the constraints on two coordinates alone allow these."""
    reach = np.array([_FAR * range_of(plant, index).reach for index in pair])
    corners = reach * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    others = np.ones(plant.n, dtype=bool)
    others[list(pair)] = False
    for row, low, high in zip(plant.box, *plant.box_ends, strict=True):
        if not row[others].any():
            for end in filter(np.isfinite, (low, high)):
                corners = _cut(corners, row[list(pair)] / end)
    return corners


def _cut(corners: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Returns the corners of the part of a convex polygon with row @ x <= 1."""
    kept: list[np.ndarray] = []
    excess = corners @ row - 1.0
    for i in range(len(corners)):
        a, b = excess[i - 1], excess[i]
        if (a > 0.0) != (b > 0.0):
            kept.append(corners[i - 1] + a / (a - b) * (corners[i] - corners[i - 1]))
        if b <= 0.0:
            kept.append(corners[i])
    return np.array(kept)


def _ellipse_points(shape: np.ndarray, count: int = 72) -> np.ndarray:
    """Returns points around the plane ellipse of shape P (2, 2), shape (count, 2)."""
    values, vectors = np.linalg.eigh(shape)
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return circle @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
