"""The color, line and marker of an arm, the same in every figure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D

from experiments.runs.arms import PENALTY_SUFFIX

# Color (Okabe and Ito's palette, which color-blind readers can distinguish) and marker (for print without color).
ARM_COLORS_AND_MARKERS = {
    "unshielded": ("#D55E00", "o"),
    "monitor": ("#4D4D4D", "D"),
    "penalized": ("#E69F00", "s"),
    "shielded": ("#0072B2", "^"),
    "shielded:project": ("#56B4E9", "v"),
    "shielded:switch": ("#009E73", "P"),
    "shielded:boundary": ("#CC79A7", "X"),
}
_SOLID, _DOTTED, _DASHED = "-", (0, (1.0, 1.3)), (0, (4.5, 1.6))


@dataclass(frozen=True)
class ArmStyle:
    """Style of an arm.

    Attributes:
        color: Hexadecimal color.
        dashes: Line style of matplotlib.
        marker: Marker of matplotlib.
        hollow: Whether markers are outlines.
        size: Size of the markers [points].
    """

    color: str
    dashes: Any
    marker: str
    hollow: bool
    size: float

    @classmethod
    def of(cls, arm: str) -> ArmStyle:
        """Returns the style of an arm: the color stands for the shield, dashed lines and hollow markers for a penalty.

        The monitor's agent is the unshielded one, so its curves lie on those of the unshielded arm and are dotted.

        Raises:
            KeyError: If the arm is unknown.
        """
        color, marker = ARM_COLORS_AND_MARKERS[arm.removesuffix(PENALTY_SUFFIX)]
        if arm == "monitor":
            return cls(color, _DOTTED, marker, hollow=True, size=11.0)
        penalized = arm.endswith(PENALTY_SUFFIX)
        return cls(color, _DASHED if penalized else _SOLID, marker, hollow=penalized, size=10.0 if penalized else 7.0)

    @property
    def line(self) -> dict[str, Any]:
        """Keyword arguments of matplotlib for lines."""
        return {"color": self.color, "ls": self.dashes}

    @property
    def points(self) -> dict[str, Any]:
        """Keyword arguments of matplotlib for markers; their fill is transparent."""
        return {
            "marker": self.marker,
            "ms": self.size,
            "mfc": "none" if self.hollow else to_rgba(self.color, 0.45),
            "mec": self.color,
            "mew": 1.3,
        }

    def handle(self, *, line: bool = True, points: bool = False) -> Line2D:
        """Returns the arm's entry in a legend."""
        shape = self.line | {"lw": 2.0} if line else {"ls": "none"}
        return Line2D([], [], **shape, **(self.points if points else {}))
