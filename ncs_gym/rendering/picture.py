"""The whole picture, composed of its parts."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering import theme
from ncs_gym.rendering.bars import BarStage
from ncs_gym.rendering.canvas import Canvas
from ncs_gym.rendering.header import draw_header
from ncs_gym.rendering.panel import draw_legend, draw_panel
from ncs_gym.rendering.plane import PhasePlane
from ncs_gym.rendering.pole import PoleStage
from ncs_gym.rendering.scene import Scene
from ncs_gym.rendering.timeline import Timeline
from ncs_gym.rendering.truck import TruckStage

TRUCK_STATES = ("coupling stretch", "stretch rate")
POLE_STATES = ("position", "speed", "angle", "angular rate")


class Stage(Protocol):
    """Draws the plant itself, in the upper part of the picture."""

    @property
    def pair(self) -> tuple[int, int]:
        """The states in the phase plane."""
        ...

    def draw_background(self, canvas: Canvas) -> None:
        """Draws what stays."""

    def draw(self, canvas: Canvas, scene: Scene) -> None:
        """Draws what moves, the packets' lane included."""


class Picture:
    """Paints scenes of one plant; needs no display.

    Args:
        plant: What its states are called decides how it is drawn: truck and trailer, cart and pole, or bars.

    Raises:
        gymnasium.error.DependencyNotInstalled: If pygame is missing.
    """

    def __init__(self, plant: LinearPlant) -> None:
        self._canvas = Canvas(theme.WIDTH, theme.HEIGHT)
        self._stage = stage_for(plant)
        plane = theme.PLANE
        self._plane = PhasePlane(plant, self._stage.pair, plane) if plant.n > 1 else Timeline(plant, plane)
        self._backgrounds: dict[tuple[int, theme.Color], tuple[Any, Any]] = {}

    def pixels(self, scene: Scene) -> np.ndarray:
        """Returns a scene as an image, shape (height, width, 3), uint8."""
        self._paint(scene)
        return self._canvas.pixels()

    def frame(self, scene: Scene) -> Any:
        """Returns a scene as a pygame surface, which the next call overwrites."""
        self._paint(scene)
        return self._canvas.frame()

    def _paint(self, scene: Scene) -> None:
        self._canvas.restore(self._background(scene))
        self._stage.draw(self._canvas, scene)
        draw_header(self._canvas, scene)
        self._plane.draw(self._canvas, scene)
        draw_panel(self._canvas, scene)

    def _background(self, scene: Scene) -> Any:
        """Returns everything that stays the same while the safe set does."""
        note, tint = scene.annotation, _tint(scene)
        safe_set = None if note is None else note.safe_set
        key = id(safe_set), tint
        if key not in self._backgrounds:
            if len(self._backgrounds) >= 8:
                self._backgrounds.clear()
            canvas = self._canvas
            canvas.clear()
            canvas.rect(theme.STAGE, tint)
            self._stage.draw_background(canvas)
            self._plane.draw_background(canvas, None if safe_set is None else safe_set.shape)
            draw_legend(canvas, shielded=safe_set is not None)
            self._backgrounds[key] = safe_set, canvas.snapshot()  # keeps the set alive, so that its id stays its own
        return self._backgrounds[key][1]


def stage_for(plant: LinearPlant) -> Stage:
    """Returns what draws a plant, by the names of its states."""
    names = tuple(plant.state_names)
    if names == TRUCK_STATES:
        return TruckStage(plant)
    return PoleStage(plant) if names == POLE_STATES else BarStage(plant)


def _tint(scene: Scene) -> theme.Color:
    """Returns the color behind the plant."""
    if scene.violated:
        return theme.DANGER_FILL
    return theme.SHIELD_FILL if scene.intervened else theme.MIST
