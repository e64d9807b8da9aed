"""The window of render mode "human"."""

from __future__ import annotations

from typing import Any

from ncs_gym.rendering.canvas import require_pygame


class Window:
    """Shows frames at a steady rate; opened by the first one.

    Args:
        title: Of the window.
        fps: Frames per second.
    """

    def __init__(self, title: str, fps: int) -> None:
        self._title, self._fps = title, fps
        self._screen: Any = None

    def show(self, frame: Any) -> None:
        """Shows a pygame surface, and waits for its turn."""
        pygame = require_pygame()
        if self._screen is None:
            pygame.display.init()
            pygame.display.set_caption(self._title)
            self._screen = pygame.display.set_mode(frame.get_size())
            self._clock = pygame.time.Clock()
        pygame.event.pump()
        self._screen.blit(frame, (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Closes the window if it is open."""
        if self._screen is not None:
            require_pygame().display.quit()
            self._screen = None
