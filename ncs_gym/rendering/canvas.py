"""What pygame does for the pictures: a drawing surface, and the window of render mode "human"."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ncs_gym.installation import install_command
from ncs_gym.rendering.theme import PAPER, SMALL, Color, Rect

# Everything is drawn this many times larger than shown and then scaled down, so that edges come out smooth.
_OVERSAMPLING = 2
# Rendered pieces of text that are kept for the next frames.
_MAX_CACHED_TEXTS = 600

_Point = Sequence[float] | np.ndarray


def _require_pygame() -> Any:
    try:
        import pygame
        import pygame.font
    except ImportError as error:
        raise gym.error.DependencyNotInstalled(f"rendering needs pygame-ce: {install_command('render')}") from error
    return pygame


class Canvas:
    """A surface on which shapes and text are placed in units of the layout; it needs no display.

    Args:
        width, height: Size of the layout.
        scale: Pixels of the finished frame per unit of the layout.

    Raises:
        gymnasium.error.DependencyNotInstalled: If pygame is missing.
    """

    def __init__(self, width: int, height: int, scale: int) -> None:
        self._pygame = _require_pygame()
        self._pygame.font.init()
        self._size, self._factor = (width * scale, height * scale), _OVERSAMPLING * scale
        self._surface = self._pygame.Surface((width * self._factor, height * self._factor), depth=32)
        self._frame = self._pygame.Surface(self._size, depth=32)
        self._fonts: dict[tuple[int, bool], Any] = {}
        self._texts: dict[tuple[str, int, bool, Color, bool], Any] = {}

    def clear(self) -> None:
        """Paints everything white."""
        self._surface.set_clip(None)
        self._surface.fill(PAPER)

    def snapshot(self) -> Any:
        """Returns a copy of everything drawn so far, for `restore`."""
        return self._surface.copy()

    def restore(self, snapshot: Any) -> None:
        """Replaces everything drawn so far by a snapshot."""
        self._surface.set_clip(None)
        self._surface.blit(snapshot, (0, 0))

    def frame(self) -> Any:
        """Returns the finished frame as a pygame surface, which the next call overwrites."""
        return self._pygame.transform.smoothscale(self._surface, self._size, self._frame)

    def pixels(self) -> np.ndarray:
        """Returns the finished frame, shape (height, width, 3), uint8."""
        width, height = self._size
        data = self._pygame.image.tobytes(self.frame(), "RGB")
        return np.frombuffer(data, np.uint8).reshape(height, width, 3).copy()

    def clip(self, rect: Rect | None) -> None:
        """Restricts all following shapes to a rectangle; None lifts the restriction."""
        self._surface.set_clip(None if rect is None else [round(self._factor * value) for value in rect])

    def rect(self, rect: Rect, color: Color, *, radius: float = 0.0, width: float = 0.0) -> None:
        """Draws a rectangle, filled unless a line width is given, with corners rounded by a radius."""
        box = [round(self._factor * value) for value in rect]
        corner = round(self._factor * radius)
        self._pygame.draw.rect(self._surface, color, box, round(self._factor * width), border_radius=corner)

    def line(self, points: Sequence[_Point] | np.ndarray, color: Color, width: float = 1.0) -> None:
        """Draws a line through points with round joints."""
        places = [(self._factor * x, self._factor * y) for x, y in points]
        thick = max(1, round(self._factor * width))
        self._pygame.draw.lines(self._surface, color, False, places, thick)
        if thick > 3:
            for place in places:
                self._pygame.draw.circle(self._surface, color, place, thick / 2)

    def dashed(
        self, points: Sequence[_Point] | np.ndarray, color: Color, width: float = 1.0, dash: float = 5.0
    ) -> None:
        """Draws dashes along a line through points; dashes and gaps are equally long."""
        corners = np.asarray(points, dtype=np.float64)
        lengths = np.concatenate([[0.0], np.hypot(*np.diff(corners, axis=0).T).cumsum()])
        for start in np.arange(0.0, lengths[-1], 2.0 * dash):
            ends = np.array([start, min(start + dash, lengths[-1])])
            inner = corners[(lengths > ends[0]) & (lengths < ends[1])]
            x, y = np.interp(ends, lengths, corners[:, 0]), np.interp(ends, lengths, corners[:, 1])
            self.line([(x[0], y[0]), *inner, (x[1], y[1])], color, width)

    def polygon(self, points: Sequence[_Point] | np.ndarray, color: Color) -> None:
        """Fills a polygon."""
        self._pygame.draw.polygon(self._surface, color, [(self._factor * x, self._factor * y) for x, y in points])

    def circle(self, center: _Point, radius: float, color: Color, *, width: float = 0.0) -> None:
        """Draws a circle, filled unless a line width is given."""
        place = self._factor * center[0], self._factor * center[1]
        self._pygame.draw.circle(self._surface, color, place, self._factor * radius, round(self._factor * width))

    def cross(self, center: _Point, radius: float, color: Color, width: float = 2.0) -> None:
        """Draws a diagonal cross."""
        x, y = center
        for sign in (-1.0, 1.0):
            self.line([(x - radius, y - sign * radius), (x + radius, y + sign * radius)], color, width)

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
        max_width: float | None = None,
    ) -> float:
        """Writes one line of text whose vertical middle is at `place`.

        Args:
            text: The line.
            place: The left end of the line, or what `align` says.
            color: Color of the letters.
            size: Size of the font [pixels].
            align: 0 puts the left end at `place`, 0.5 the middle, 1 the right end.
            bold: Whether to use the bold font.
            upright: Whether to turn the line by 90 degrees; `place` is its middle then.
            max_width: Of longer lines the middle is left out [pixels].

        Returns:
            Width of the line [pixels].
        """
        whole, kept = text, len(text)
        while max_width is not None and kept > 1 and self.text_width(text, size, bold=bold) > max_width:
            kept -= 1
            text = f"{whole[: kept // 2]}\N{HORIZONTAL ELLIPSIS}{whole[-(kept - kept // 2) :]}"
        image = self._text(text, size, bold, color, upright)
        width, height = image.get_size()
        anchor = 0.5 if upright else align
        corner = self._factor * place[0] - anchor * width, self._factor * place[1] - 0.5 * height
        self._surface.blit(image, (round(corner[0]), round(corner[1])))
        return width / self._factor

    def text_width(self, text: str, size: int = SMALL, *, bold: bool = False) -> float:
        """Returns the width of a line of text [pixels]."""
        return self._font(size, bold).size(text)[0] / self._factor

    def _text(self, text: str, size: int, bold: bool, color: Color, upright: bool) -> Any:
        key = text, size, bold, color, upright
        if key not in self._texts:
            if len(self._texts) >= _MAX_CACHED_TEXTS:
                self._texts.clear()
            image = self._font(size, bold).render(text, True, color)
            self._texts[key] = self._pygame.transform.rotate(image, 90) if upright else image
        return self._texts[key]

    def _font(self, size: int, bold: bool) -> Any:
        if (size, bold) not in self._fonts:
            self._fonts[size, bold] = self._pygame.font.Font(_font_file(bold), self._factor * size)
        return self._fonts[size, bold]


class Window:
    """A window that shows frames at a steady rate; the first frame opens it.

    Args:
        title: Title of the window.
        fps: Frames shown per second.
    """

    def __init__(self, title: str, fps: int) -> None:
        self._title, self._fps = title, fps
        self._screen: Any = None

    def show(self, frame: Any) -> None:
        """Shows a pygame surface, and waits until the previous one was shown long enough."""
        pygame = _require_pygame()
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
            _require_pygame().display.quit()
            self._screen = None


def _font_file(bold: bool) -> str | None:
    """Returns the file of matplotlib's DejaVu Sans, which looks alike on every machine; None without matplotlib."""
    found = importlib.util.find_spec("matplotlib")
    if found is None or found.origin is None:
        return None
    file = Path(found.origin).parent / "mpl-data" / "fonts" / "ttf" / f"DejaVuSans{'-Bold' if bold else ''}.ttf"
    return str(file) if file.is_file() else None
