"""How a frame looks: its layout in pixels, its colors, and how numbers and units are written.

The colors stay apart for color-blind readers (hues of Okabe and Ito), and no meaning rests on hue alone: the lost
packet is a cross, the estimate is dashed or hollow, limits are dashed, and a violation is also written in words.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
