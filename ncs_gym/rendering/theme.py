"""Colors, sizes and the frame's layout, in pixels.

The colors stay apart for color-blind readers (hues of Okabe and Ito), and nothing is told by hue alone: the lost packet
is a cross, the estimate dashed or hollow, the safe box dashed, a violation says so.
"""

from __future__ import annotations

from typing import NamedTuple

Color = tuple[int, int, int]


class Rect(NamedTuple):
    """A rectangle with its top left corner at (x, y)."""

    x: float
    y: float
    w: float
    h: float

    @property
    def right(self) -> float:
        """Right edge."""
        return self.x + self.w

    @property
    def bottom(self) -> float:
        """Lower edge."""
        return self.y + self.h


WIDTH, HEIGHT = 640, 480
HEADER = Rect(0, 0, WIDTH, 40)
STAGE = Rect(0, 40, WIDTH, 176)
PLANE = Rect(64, 228, 236, 196)
PANEL = Rect(330, 228, 294, 244)
# Where the packets' lane is, for which every stage leaves room.
LANE = STAGE.y + 32

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
STEEL: Color = (88, 110, 134)
BODYWORK: Color = (10, 80, 132)
LOAD: Color = (180, 190, 200)
CRATE: Color = (138, 153, 170)
GLASS: Color = (204, 225, 240)

SMALL, BODY, LARGE = 13, 14, 17


def blend(first: Color, second: Color, share: float) -> Color:
    """Returns a mixture: the first color at share 0, the second at 1."""
    share = min(max(share, 0.0), 1.0)
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(first, second, strict=True))
    return red, green, blue


def strain(share: float) -> Color:
    """Returns the color of something that uses a share of its limit: steel, turning red from 60 % on."""
    return blend(STEEL, DANGER, (abs(share) - 0.6) / 0.35)
