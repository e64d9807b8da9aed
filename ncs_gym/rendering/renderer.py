"""Draws the frames of an environment: records its episode, composes the parts of a frame, shows a window."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.past_inputs import inputs_under_way
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas, Window
from ncs_gym.rendering.cart_pole import CartPoleDrawing
from ncs_gym.rendering.constraint_bars import ConstraintBarsDrawing
from ncs_gym.rendering.episode_record import Annotation, EpisodeRecord, FrameRecord, PacketRecord
from ncs_gym.rendering.panel import draw_header, draw_legend, draw_panel
from ncs_gym.rendering.phase_plane import PhasePlane, TimePlot
from ncs_gym.rendering.truck_trailer import TruckTrailerDrawing
from ncs_gym.tasks.base_task import Task

_TITLE = "ncs-gym"
# A background is kept for each safe set and color behind the plant, at most this many.
_MAX_BACKGROUNDS = 8
# Names of the states by which a plant with a drawing of its own is recognized.
_TRUCK_TRAILER_STATES = ("coupling stretch", "stretch rate")
_CART_POLE_STATES = ("position", "speed", "angle", "angular rate")


class Renderer:
    """Everything an environment with a render mode needs for its pictures; pygame is imported for the first frame.

    Copies and pickles of it leave out surfaces and window.

    Args:
        plant: The plant that is drawn.
        task: The task, whose tracked output is drawn.
        render_mode: "human" shows every recorded step in a window; "rgb_array" draws only when `render` is called.
        fps: Frames per second of the window.
    """

    def __init__(self, plant: LinearPlant, task: Task, render_mode: str, fps: int) -> None:
        self._plant, self._render_mode, self._fps = plant, render_mode, fps
        self._episode = EpisodeRecord(plant, task)
        self._picture: _Picture | None = None
        self._window: Window | None = None
        self._scale = 1

    @property
    def scale(self) -> int:
        """Pixels of a frame per unit of its layout of 640 by 480; 2 is sharp on dense screens."""
        return self._scale

    @scale.setter
    def scale(self, scale: int) -> None:
        self._scale, self._picture = scale, None

    def begin(self, info: Mapping[str, Any], task_state: Any) -> None:
        """Starts an episode.

        Args:
            info: The info that `reset` returns.
            task_state: State of the task.

        Raises:
            gymnasium.error.DependencyNotInstalled: If pygame is missing and the mode is "human".
        """
        self._episode.begin(info, task_state)
        self._show()

    def record(self, info: Mapping[str, Any], task_state: Any, sent: PacketRecord | None) -> None:
        """Adds a step of the episode.

        Args:
            info: The info that `step` returns.
            task_state: State of the task after this step.
            sent: What became of the sample of this step; None where none is sent.

        Raises:
            gymnasium.error.DependencyNotInstalled: If pygame is missing and the mode is "human".
        """
        self._episode.add(info, task_state, sent)
        self._show()

    def annotate(self, annotation: Annotation) -> None:
        """Stores what a shield knows, for the picture of the next step or reset alone."""
        self._episode.annotate(annotation)

    def render(self) -> np.ndarray | None:
        """Returns the present frame, shape (height, width, 3), uint8; in mode "human" shows it and returns None.

        Raises:
            gymnasium.error.DependencyNotInstalled: If pygame is missing.
        """
        if self._render_mode == "human":
            return self._show()
        return self._draw().pixels()

    def close(self) -> None:
        """Closes the window; the next frame opens it again."""
        if self._window is not None:
            self._window.close()
        self._window = self._picture = None

    def frame_record(self) -> FrameRecord:
        """Returns what the present frame shows, as data."""
        return self._episode.frame()

    def _show(self) -> None:
        if self._render_mode != "human":
            return
        canvas = self._draw()
        if self._window is None:
            self._window = Window(_TITLE, self._fps)
        self._window.show(canvas.frame())

    def _draw(self) -> Canvas:
        if self._picture is None:
            self._picture = _Picture(self._plant, self._scale)
        return self._picture.draw(self.frame_record())

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_picture": None, "_window": None}


class _Picture:
    """Draws frames of one plant; it needs no display.

    Args:
        plant: The plant. The names of its states decide whether it is drawn as truck and trailer, as cart and pole, or
            with a bar for every constraint.
        scale: Pixels of a frame per unit of its layout.
    """

    def __init__(self, plant: LinearPlant, scale: int) -> None:
        self._canvas = Canvas(theme.WIDTH, theme.HEIGHT, scale)
        self._drawing = _drawing_of(plant)
        rect = theme.PLANE
        own = plant.n - inputs_under_way(plant)
        self._plane = PhasePlane(plant, self._drawing.pair, rect) if own > 1 else TimePlot(plant, rect)
        self._backgrounds: dict[tuple[int, theme.Color, bool], tuple[Any, Any]] = {}

    def draw(self, frame: FrameRecord) -> Canvas:
        """Returns the canvas with a frame drawn on it, which the next call overwrites."""
        self._canvas.restore(self._background(frame))
        self._drawing.draw(self._canvas, frame)
        draw_header(self._canvas, frame)
        self._plane.draw(self._canvas, frame)
        draw_panel(self._canvas, frame)
        return self._canvas

    def _background(self, frame: FrameRecord) -> Any:
        """Returns a snapshot of everything that stays the same as long as the safe set does."""
        annotation, color = frame.annotation, _background_color(frame)
        safe_set = None if annotation is None else annotation.safe_set
        stores_plans = annotation is not None and annotation.plan is not None
        key = id(safe_set), color, stores_plans
        if key not in self._backgrounds:
            if len(self._backgrounds) >= _MAX_BACKGROUNDS:
                self._backgrounds.clear()
            canvas = self._canvas
            canvas.clear()
            canvas.rect(theme.PLANT_VIEW, color)
            self._drawing.draw_background(canvas)
            self._plane.draw_background(canvas, safe_set)
            draw_legend(canvas, shielded=safe_set is not None, plans=stores_plans)
            self._backgrounds[key] = safe_set, canvas.snapshot()  # keeps the set alive, so that its id stays its own
        return self._backgrounds[key][1]


class _PlantDrawing(Protocol):
    """Draws the plant itself, in the upper part of the frame."""

    @property
    def pair(self) -> tuple[int, int]:
        """Indices of the states in the phase plane."""
        ...

    def draw_background(self, canvas: Canvas) -> None:
        """Draws what does not move."""

    def draw(self, canvas: Canvas, frame: FrameRecord) -> None:
        """Draws what moves, the packets included."""


def _drawing_of(plant: LinearPlant) -> _PlantDrawing:
    names = tuple(plant.state_names)
    if names == _TRUCK_TRAILER_STATES:
        return TruckTrailerDrawing(plant)
    return CartPoleDrawing(plant) if names == _CART_POLE_STATES else ConstraintBarsDrawing(plant)


def _background_color(frame: FrameRecord) -> theme.Color:
    """Returns the color behind the plant, which shows violations and interventions."""
    if frame.violated:
        return theme.DANGER_FILL
    return theme.SHIELD_FILL if frame.intervened else theme.MIST
