"""The phase plane: limits, safe set, error bound and recent path in two coordinates, or of one state against time."""

from __future__ import annotations

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.episode_record import RECENT_STEPS, Annotation, ConvexSet, EpisodeRecord
from ncs_gym.uncertainty.ellipsoid import Ellipsoid

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
        """Draws the limits, the safe set and the grid."""
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
