"""What an environment that is drawn carries along: its recent past, its picture, its window."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.rendering.history import History
from ncs_gym.rendering.picture import Picture
from ncs_gym.rendering.scene import Scene
from ncs_gym.rendering.window import Window


class Film:
    """The history of an episode, and what paints it; pygame is imported for the first frame.

    Args:
        plant: What is drawn.
        title: Of the window.
        fps: Frames per second of the window.
    """

    def __init__(self, plant: LinearPlant, title: str, fps: int) -> None:
        self.history = History()
        self._plant, self._title, self._fps = plant, title, fps
        self._picture: Picture | None = None
        self._window: Window | None = None

    def pixels(self, scene: Scene) -> np.ndarray:
        """Returns a scene as an image, shape (height, width, 3), uint8."""
        return self._painter().pixels(scene)

    def show(self, scene: Scene) -> None:
        """Shows a scene in the window."""
        frame = self._painter().frame(scene)
        if self._window is None:
            self._window = Window(self._title, self._fps)
        self._window.show(frame)

    def close(self) -> None:
        """Closes the window; the next frame opens it again."""
        if self._window is not None:
            self._window.close()
        self._window = self._picture = None

    def _painter(self) -> Picture:
        if self._picture is None:
            self._picture = Picture(self._plant)
        return self._picture

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out surfaces and window, which cannot be copied."""
        return vars(self) | {"_picture": None, "_window": None}
