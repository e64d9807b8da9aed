"""What pygame does for the pictures: a drawing surface, and the window of render mode "human"."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ncs_gym.installation import install_command
from ncs_gym.rendering.theme import HEIGHT, SMALL, WIDTH, Color, Rect

# Everything is drawn this many times larger than shown and then scaled down, so that edges come out smooth.
_OVERSAMPLING = 2

_Point = Sequence[float] | np.ndarray
_Points = Sequence[_Point] | np.ndarray


class Canvas:
    """A surface on which shapes and text are placed in units of the layout; it needs no display.

    Args:
        scale: Pixels of the finished frame per unit of the layout.

    Raises:
        gymnasium.error.DependencyNotInstalled: If pygame is missing.
    """

    def __init__(self, scale: int) -> None:
        try:
            import pygame
            import pygame.font
        except ImportError as error:
            raise gym.error.DependencyNotInstalled(f"rendering needs pygame-ce: {install_command('render')}") from error
        pygame.font.init()
        self._pygame, self._size, self._factor = pygame, (WIDTH * scale, HEIGHT * scale), _OVERSAMPLING * scale
        self._surface = pygame.Surface((WIDTH * self._factor, HEIGHT * self._factor), depth=32)
        self._screen: Any = None
        self._fonts: dict[tuple[int, bool], Any] = {}

    def pixels(self) -> np.ndarray:
        """Returns the finished frame, shape (height, width, 3), uint8."""
        frame = self._pygame.transform.smoothscale(self._surface, self._size)
        data = np.frombuffer(self._pygame.image.tobytes(frame, "RGB"), np.uint8)
        return data.reshape(self._size[1], self._size[0], 3).copy()

    def show(self, title: str, fps: int) -> None:
        """Shows the finished frame in a window, and waits until the previous one was shown long enough."""
        pygame = self._pygame
        if self._screen is None:
            pygame.display.init()
            pygame.display.set_caption(title)
            self._screen, self._clock = pygame.display.set_mode(self._size), pygame.time.Clock()
        pygame.event.pump()
        self._screen.blit(pygame.transform.smoothscale(self._surface, self._size), (0, 0))
        pygame.display.flip()
        self._clock.tick(fps)

    def close(self) -> None:
        """Closes the window if it is open."""
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = None

    def clip(self, rect: Rect | None) -> None:
        """Restricts all following shapes to a rectangle, or to nothing."""
        self._surface.set_clip(None if rect is None else [round(self._factor * value) for value in rect])

    def rect(self, rect: Rect, color: Color, *, radius: float = 0.0, width: float = 0.0) -> None:
        """Draws a rectangle, filled unless a line width is given, with corners rounded by a radius."""
        (*box, corner, thick) = (round(self._factor * value) for value in (*rect, radius, width))
        self._pygame.draw.rect(self._surface, color, box, thick, border_radius=corner)

    def line(self, points: _Points, color: Color, width: float = 1.0) -> None:
        """Draws a line through points with round joints."""
        places = [(self._factor * x, self._factor * y) for x, y in points]
        thick = max(1, round(self._factor * width))
        self._pygame.draw.lines(self._surface, color, False, places, thick)
        if thick > 3:
            for place in places:
                self._pygame.draw.circle(self._surface, color, place, thick / 2)

    def dashed(self, points: _Points, color: Color, width: float = 1.0, dash: float = 5.0) -> None:
        """Draws dashes along a line through points; dashes and gaps are equally long."""
        corners = np.asarray(points, dtype=np.float64)
        lengths = np.concatenate([[0.0], np.hypot(*np.diff(corners, axis=0).T).cumsum()])
        places = np.append(np.arange(0.0, lengths[-1], dash), lengths[-1])
        ends = np.stack([np.interp(places, lengths, along) for along in corners.T], axis=1)
        for i in range(0, len(places) - 1, 2):
            self.line(ends[i : i + 2], color, width)

    def polygon(self, points: _Points, color: Color) -> None:
        """Fills a polygon."""
        self._pygame.draw.polygon(self._surface, color, [(self._factor * x, self._factor * y) for x, y in points])

    def circle(self, center: _Point, radius: float, color: Color, *, width: float = 0.0) -> None:
        """Draws a circle, filled unless a line width is given."""
        place = self._factor * center[0], self._factor * center[1]
        self._pygame.draw.circle(self._surface, color, place, self._factor * radius, round(self._factor * width))

    def text(
        self,
        text: str,
        place: _Point,
        color: Color,
        size: int = SMALL,
        *,
        align: float = 0.0,
        bold: bool = False,
        upright: bool = False,
        max_width: float = WIDTH,
    ) -> float:
        """Writes one line of text whose vertical middle is at `place`, and returns its width [pixels].

        `align` puts its left end (0), middle (0.5) or right end (1) there, `upright` turns it by 90 degrees about its
        middle. Of lines longer than `max_width` [pixels] the middle is left out.
        """
        whole, kept = text, len(text)
        while kept > 1 and self.text_width(text, size, bold=bold) > max_width:
            kept -= 1
            text = f"{whole[: kept // 2]}\N{HORIZONTAL ELLIPSIS}{whole[-(kept - kept // 2) :]}"
        image = self._font(size, bold).render(text, True, color)
        if upright:
            image, align = self._pygame.transform.rotate(image, 90), 0.5
        width, height = image.get_size()
        corner = self._factor * place[0] - align * width, self._factor * place[1] - 0.5 * height
        self._surface.blit(image, (round(corner[0]), round(corner[1])))
        return width / self._factor

    def text_width(self, text: str, size: int = SMALL, *, bold: bool = False) -> float:
        """Returns the width of a line of text [pixels]."""
        return self._font(size, bold).size(text)[0] / self._factor

    def _font(self, size: int, bold: bool) -> Any:
        """Returns matplotlib's DejaVu Sans, which looks alike on every machine."""
        if (size, bold) not in self._fonts:
            import matplotlib

            file = Path(matplotlib.get_data_path(), "fonts", "ttf", f"DejaVuSans{'-Bold' if bold else ''}.ttf")
            self._fonts[size, bold] = self._pygame.font.Font(file, self._factor * size)
        return self._fonts[size, bold]
