"""How a frame looks: its layout, colors, texts of numbers and units, and the surface that pygame draws on.

The colors stay apart for color-blind readers (hues of Okabe and Ito), and no meaning rests on hue alone: the lost
packet is a cross, the estimate is dashed or hollow, limits are dashed, and a violation is also written in words.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from ncs_gym.installation import install_command

Color = tuple[int, int, int]


class Rect(NamedTuple):
    """A rectangle with its top left corner at (x, y) [pixels]."""

    x: float
    y: float
    w: float
    h: float

    @property
    def right(self) -> float:
        """The x coordinate of the right edge."""
        return self.x + self.w

    @property
    def bottom(self) -> float:
        """The y coordinate of the lower edge."""
        return self.y + self.h


WIDTH, HEIGHT = 640, 480
HEADER, PLANT_VIEW = Rect(0, 0, WIDTH, 40), Rect(0, 40, WIDTH, 176)
PLANE, PANEL = Rect(72, 228, 232, 196), Rect(330, 228, 294, 244)
# Height of the line on which packets travel; every drawing of a plant leaves it free.
PACKET_LINE = PLANT_VIEW.y + 32
# Font sizes.
SMALL, BODY, LARGE = 13, 14, 17

PAPER: Color = (255, 255, 255)
MIST: Color = (244, 246, 249)
GRID: Color = (226, 231, 237)
FAINT: Color = (176, 186, 197)
MUTED: Color = (92, 104, 118)
INK: Color = (28, 36, 46)
SAFE: Color = (0, 138, 100)
SAFE_FILL: Color = (220, 241, 233)
DANGER: Color = (208, 36, 36)
DANGER_FILL: Color = (252, 232, 230)
ESTIMATE: Color = (0, 104, 178)
LATE: Color = (222, 142, 0)
LATE_TEXT: Color = (156, 92, 0)
ERROR_FILL: Color = (253, 236, 200)
SHIELD: Color = (116, 44, 186)
SHIELD_FILL: Color = (236, 224, 248)
PLAN: Color = (196, 0, 132)
STEEL: Color = (88, 110, 134)
BODYWORK: Color = (10, 80, 132)
CRATE: Color = (138, 153, 170)
GLASS: Color = (204, 225, 240)


def blend(first: Color, second: Color, fraction: float) -> Color:
    """Returns a mixture of two colors: the first at fraction 0, the second at fraction 1."""
    red, green, blue = np.rint(first + np.clip(fraction, 0.0, 1.0) * np.subtract(second, first)).astype(int).tolist()
    return red, green, blue


def load_color(fraction: float) -> Color:
    """Returns the color of something that uses a fraction of its limit: steel, turning red from 60 % on."""
    return blend(STEEL, DANGER, (abs(fraction) - 0.6) / 0.35)


def tick_label(value: float, half: float) -> str:
    """Returns a number for an axis of this half range: three digits of the longest one and a true minus sign."""
    text = f"{value:.3g}" if abs(value) >= 1e-12 else "0"
    if 1e-4 <= half < 1e5:
        text = f"{value:z.{max(2 - int(np.floor(np.log10(half))), 1)}f}".rstrip("0").rstrip(".")
    return text.replace("-", "\N{MINUS SIGN}")


def value_label(value: float, limit: float, unit: str = "") -> str:
    """Returns a changing value and its unit; the number of decimals depends on the limit alone."""
    decimals = int(np.clip(2 - np.floor(np.log10(limit)), 0, 6)) if 0.0 < limit < 1e300 else 2
    number = f"{value:+z.{decimals}f}" if abs(value) < 1e6 else f"{value:+.1e}"
    return f"{number} {unit_label(unit)}".strip().replace("-", "\N{MINUS SIGN}")


def unit_label(unit: str) -> str:
    """Returns a unit with its powers as superscripts."""
    return unit.replace("^2", "\N{SUPERSCRIPT TWO}").replace("^3", "\N{SUPERSCRIPT THREE}")


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
