"""A drawing surface: pygame at twice the size, smoothly scaled down."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ncs_gym.rendering.theme import PAPER, SMALL, Color, Rect

# Everything is drawn this many times larger than shown: edges come out smooth.
OVERSAMPLING = 2
# Rendered pieces of text that are kept.
MOST_TEXTS = 600

Point = Sequence[float] | np.ndarray


def require_pygame() -> Any:
    """Returns the module pygame.

    Raises:
        gymnasium.error.DependencyNotInstalled: If it is not installed.
    """
    try:
        import pygame
        import pygame.font
    except ImportError as error:
        raise gym.error.DependencyNotInstalled('rendering needs pygame-ce: pip install "ncs-gym[render]"') from error
    return pygame


class Canvas:
    """Shapes and text in pixels of the finished frame; needs no display.

    Args:
        width, height: Size of the frame [pixels].

    Raises:
        gymnasium.error.DependencyNotInstalled: If pygame is missing.
    """

    def __init__(self, width: int, height: int) -> None:
        self._pygame = require_pygame()
        self._pygame.font.init()
        self.size = width, height
        self.surface = self._pygame.Surface((width * OVERSAMPLING, height * OVERSAMPLING), depth=32)
        self._frame = self._pygame.Surface((width, height), depth=32)
        self._fonts: dict[tuple[int, bool], Any] = {}
        self._texts: dict[tuple[str, int, bool, Color, bool], Any] = {}

    def clear(self) -> None:
        """Paints everything white."""
        self.surface.set_clip(None)
        self.surface.fill(PAPER)

    def snapshot(self) -> Any:
        """Returns a copy of what is drawn, for `restore`."""
        return self.surface.copy()

    def restore(self, snapshot: Any) -> None:
        """Draws a snapshot over everything."""
        self.surface.set_clip(None)
        self.surface.blit(snapshot, (0, 0))

    def frame(self) -> Any:
        """Returns the finished picture as a pygame surface, which the next call overwrites."""
        return self._pygame.transform.smoothscale(self.surface, self.size, self._frame)

    def pixels(self) -> np.ndarray:
        """Returns the finished picture, shape (height, width, 3), uint8."""
        width, height = self.size
        data = self._pygame.image.tobytes(self.frame(), "RGB")
        return np.frombuffer(data, np.uint8).reshape(height, width, 3).copy()

    def clip(self, rect: Rect | None) -> None:
        """Keeps what follows inside a rectangle; None lifts that."""
        self.surface.set_clip(None if rect is None else [round(OVERSAMPLING * value) for value in rect])

    def rect(self, rect: Rect, color: Color, *, radius: float = 0.0, width: float = 0.0) -> None:
        """Draws a rectangle, filled unless a line width is given."""
        box = [round(OVERSAMPLING * value) for value in rect]
        corner = round(OVERSAMPLING * radius)
        self._pygame.draw.rect(self.surface, color, box, round(OVERSAMPLING * width), border_radius=corner)

    def line(self, points: Sequence[Point] | np.ndarray, color: Color, width: float = 1.0) -> None:
        """Draws a line through points with round joints."""
        places = [(OVERSAMPLING * x, OVERSAMPLING * y) for x, y in points]
        thick = max(1, round(OVERSAMPLING * width))
        self._pygame.draw.lines(self.surface, color, False, places, thick)
        if thick > 3:
            for place in places:
                self._pygame.draw.circle(self.surface, color, place, thick / 2)

    def dashed(self, points: Sequence[Point] | np.ndarray, color: Color, width: float = 1.0, dash: float = 5.0) -> None:
        """Draws dashes along a line through points; dashes and gaps are equally long."""
        corners = np.asarray(points, dtype=np.float64)
        lengths = np.concatenate([[0.0], np.hypot(*np.diff(corners, axis=0).T).cumsum()])
        for start in np.arange(0.0, lengths[-1], 2.0 * dash):
            ends = np.array([start, min(start + dash, lengths[-1])])
            inner = corners[(lengths > ends[0]) & (lengths < ends[1])]
            x, y = np.interp(ends, lengths, corners[:, 0]), np.interp(ends, lengths, corners[:, 1])
            self.line([(x[0], y[0]), *inner, (x[1], y[1])], color, width)

    def polygon(self, points: Sequence[Point] | np.ndarray, color: Color) -> None:
        """Fills a polygon."""
        self._pygame.draw.polygon(self.surface, color, [(OVERSAMPLING * x, OVERSAMPLING * y) for x, y in points])

    def circle(self, center: Point, radius: float, color: Color, *, width: float = 0.0) -> None:
        """Draws a circle, filled unless a line width is given."""
        place = OVERSAMPLING * center[0], OVERSAMPLING * center[1]
        self._pygame.draw.circle(self.surface, color, place, OVERSAMPLING * radius, round(OVERSAMPLING * width))

    def cross(self, center: Point, radius: float, color: Color, width: float = 2.0) -> None:
        """Draws a diagonal cross."""
        x, y = center
        for sign in (-1.0, 1.0):
            self.line([(x - radius, y - sign * radius), (x + radius, y + sign * radius)], color, width)

    def text(
        self,
        text: str,
        place: Point,
        color: Color,
        size: int = SMALL,
        *,
        align: float = 0.0,
        bold: bool = False,
        upright: bool = False,
        most: float | None = None,
    ) -> float:
        """Writes text whose vertical middle is at `place`.

        Args:
            text: One line.
            place: Left end, or wherever `align` says.
            color: Of the letters.
            size: Of the font [pixels].
            align: 0 puts the left end at `place`, 0.5 the middle, 1 the right end.
            bold: Whether to use the bold font.
            upright: Turns it by 90 degrees; `place` is its middle then.
            most: Cuts it to this length [pixels].

        Returns:
            Its width [pixels].
        """
        while most is not None and len(text) > 1 and self.text_width(text, size, bold=bold) > most:
            text = text[:-2] + "\N{HORIZONTAL ELLIPSIS}"
        image = self._text(text, size, bold, color, upright)
        width, height = image.get_size()
        share = 0.5 if upright else align
        corner = OVERSAMPLING * place[0] - share * width, OVERSAMPLING * place[1] - 0.5 * height
        self.surface.blit(image, (round(corner[0]), round(corner[1])))
        return width / OVERSAMPLING

    def text_width(self, text: str, size: int = SMALL, *, bold: bool = False) -> float:
        """Returns how wide a text will be [pixels]."""
        return self._font(size, bold).size(text)[0] / OVERSAMPLING

    def _text(self, text: str, size: int, bold: bool, color: Color, upright: bool) -> Any:
        key = text, size, bold, color, upright
        if key not in self._texts:
            if len(self._texts) >= MOST_TEXTS:
                self._texts.clear()
            image = self._font(size, bold).render(text, True, color)
            self._texts[key] = self._pygame.transform.rotate(image, 90) if upright else image
        return self._texts[key]

    def _font(self, size: int, bold: bool) -> Any:
        if (size, bold) not in self._fonts:
            self._fonts[size, bold] = self._pygame.font.Font(_font_file(bold), OVERSAMPLING * size)
        return self._fonts[size, bold]


def _font_file(bold: bool) -> str | None:
    """Returns matplotlib's DejaVu Sans, which filterpy brings and which looks alike everywhere; None without it."""
    found = importlib.util.find_spec("matplotlib")
    if found is None or found.origin is None:
        return None
    file = Path(found.origin).parent / "mpl-data" / "fonts" / "ttf" / f"DejaVuSans{'-Bold' if bold else ''}.ttf"
    return str(file) if file.is_file() else None
