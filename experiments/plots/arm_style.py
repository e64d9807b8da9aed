"""How an arm looks in every figure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D

from experiments.runs.arms import PENALTY

# Okabe and Ito's palette, which color-blind readers can tell apart; a marker each, for print without color.
LOOKS = {
    "unshielded": ("#D55E00", "o"),
    "monitor": ("#4D4D4D", "D"),
    "penalized": ("#E69F00", "s"),
    "shielded": ("#0072B2", "^"),
    "shielded:project": ("#56B4E9", "v"),
    "shielded:switch": ("#009E73", "P"),
    "shielded:boundary": ("#CC79A7", "X"),
}
SOLID, DOTTED, DASHED = "-", (0, (1.0, 1.3)), (0, (4.5, 1.6))


@dataclass(frozen=True)
class ArmStyle:
    """Look of an arm.

    Attributes:
        color: Hexadecimal.
        dashes: A line style of matplotlib.
        marker: A marker of matplotlib.
        hollow: Whether markers are outlines.
        size: Of markers [points].
    """

    color: str
    dashes: Any
    marker: str
    hollow: bool
    size: float

    @property
    def line(self) -> dict[str, Any]:
        """Keyword arguments of a line."""
        return {"color": self.color, "ls": self.dashes}

    @property
    def points(self) -> dict[str, Any]:
        """Keyword arguments of markers, whose fill lets one see others below."""
        return {
            "marker": self.marker,
            "ms": self.size,
            "mfc": "none" if self.hollow else to_rgba(self.color, 0.45),
            "mec": self.color,
            "mew": 1.3,
        }

    def handle(self, *, line: bool = True, points: bool = False) -> Line2D:
        """Returns an entry of a legend."""
        shape = self.line | {"lw": 2.0} if line else {"ls": "none"}
        return Line2D([], [], **shape, **(self.points if points else {}))


def style_of(arm: str) -> ArmStyle:
    """Returns the look of an arm: its color is that of its shield, with a penalty it is dashed and hollow.

    The monitor's agent is the unshielded one, so its curves lie on the unshielded ones: dotted and hollow, both show.

    Raises:
        KeyError: If the arm is unknown.
    """
    color, marker = LOOKS[arm.removesuffix(PENALTY)]
    if arm == "monitor":
        return ArmStyle(color, DOTTED, marker, hollow=True, size=11.0)
    priced = arm.endswith(PENALTY)
    return ArmStyle(color, DASHED if priced else SOLID, marker, hollow=priced, size=10.0 if priced else 7.0)
