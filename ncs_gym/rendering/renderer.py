"""Draws the frames of an environment: records its episode, composes the parts of a frame, shows a window."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.drawings import drawing_of
from ncs_gym.rendering.episode_record import Annotation, EpisodeRecord
from ncs_gym.rendering.panel import draw_header, draw_panel
from ncs_gym.rendering.phase_plane import PhasePlane
from ncs_gym.tasks.base_task import Task


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

    def begin(self, info: Mapping[str, Any], task_state: Any, note: Annotation | None = None) -> None:
        """Starts an episode, with the info that `reset` returns, the state of the task, and what a shield knows."""
        self.episode.begin(info, task_state, note)
        self._show()

    def record(
        self, info: Mapping[str, Any], task_state: Any, sent: tuple[int, Any] | None, note: Annotation | None = None
    ) -> None:
        """Adds a step, with its info, the state of the task after it, its sample (None where none is sent)."""
        self.episode.add(info, task_state, sent, note)
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
