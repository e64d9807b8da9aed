"""What a certificate is for, and how a loop runs under one, in words, for people."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np

from ncs_gym import ChannelContract, LinearPlant
from ncs_gym.plants.linear_plant import row_limit
from ncs_gym.validation import counted, printable

_WIDTH, _INDENT = 80, 14


@dataclass(frozen=True)
class Reach:
    """How far a limited quantity gets inside the safe set, in percent of the way from the operating point to its ends.

    It is a number of a solver, for planning: nothing is proved with it.

    Attributes:
        limit: The limit in words, as `print(plant)` says it.
        low, high: Percent of the way to the low and to the high end, None for an end that is open; negative where the
            set does not get to the operating point.
    """

    limit: str
    low: float | None
    high: float | None

    def __str__(self) -> str:
        ends = [f"{0.0 + round(each, 2):.4g} %" for each in (self.low, self.high) if each is not None]
        return f"{' and '.join(dict.fromkeys(ends))} of {self.limit}"


def reach_in(safe_set: Any, plant: LinearPlant) -> tuple[Reach, ...]:
    """Returns what `shields.reach_of` does, of any set inside the safe box; raises ValueError if a solver fails."""

    def percent(row: np.ndarray, end: float) -> float | None:
        if not np.isfinite(end):
            return None
        return 100.0 * float(safe_set.support(np.sign(end) * row)) / abs(end)

    return tuple(
        Reach(row_limit(plant, j), *(percent(plant.box[j], end) for end in plant.box_ends[:, j].tolist()))
        for j in np.flatnonzero(~plant.is_past_row).tolist()
    )


def size_of(recorded: dict[str, Any]) -> str:
    """Returns the recorded shares of the safe box and of the largest ellipsoid in it, or else the recorded reach."""
    at_rest = "{:.4g} % of the volume of the safe box of the states, with no input under way"
    reach = recorded.get("reach")
    reached = ", ".join(each for each in reach if isinstance(each, str)) if isinstance(reach, list) else ""
    sizes = (
        _text(recorded.get("share_of_box"), "{:.4g} % of the safe box's volume", 100.0),
        _text(recorded.get("share_of_box_at_rest"), at_rest, 100.0),
        reached and f"up to {reached}",
        _text(recorded.get("volume_of_box_ellipsoid"), "{:.4g} % of the largest ellipsoid in the box", 100.0),
    )
    return ", ".join(filter(None, sizes))


def table(title: str, rows: list[tuple[str, str]]) -> str:
    """Returns a title and named texts below it, without those that are empty."""
    return "\n".join([title, *(labeled(f"  {name}".ljust(_INDENT), printable(text)) for name, text in rows if text)])


def labeled(label: str, text: str) -> str:
    """Returns a text behind a label, in lines that all begin where the first does."""
    indent = " " * len(label)
    return textwrap.fill(text, _WIDTH, initial_indent=label, subsequent_indent=indent, break_on_hyphens=False)


def contract_text(contract: ChannelContract | None) -> str:
    """Returns what the channel has to promise."""
    if contract is None:
        return "none: any packets may be lost or late"
    step = contract.quantization_step
    rounding = f"rounded to {step:g} or finer" if step else "not rounded"
    return f"the newest sample is never older than {counted(contract.max_age, 'step')}; samples are {rounding}"


def provenance_rows(recorded: dict[str, Any]) -> list[tuple[str, str]]:
    """Returns what the provenance of a certificate says of how it was made, named, and empty where it says nothing."""
    scale = "some set exists for disturbances and estimation errors up to {:.2f} times those assumed"
    given, stage = recorded.get("assumptions"), recorded.get("interrupted_at")
    assumed = " ".join(each for each in given if isinstance(each, str)) if isinstance(given, list) else ""
    stopped = f"the synthesis was stopped at {stage}: other sets may be larger" if isinstance(stage, str) else ""
    tolerance, missing = _text(recorded.get("tolerated_scale"), scale), recorded.get("no_polytope")
    polytope = f"none: {missing}; shields keep the state in the ellipsoid" if isinstance(missing, str) else ""
    return [("polytope", polytope), ("tolerance", tolerance), ("assumes", assumed), ("interrupted", stopped)]


def _text(value: Any, pattern: str, scale: float = 1.0) -> str:
    """Returns a recorded number, scaled, in a pattern; an empty string for anything else that a file holds."""
    return pattern.format(scale * value) if isinstance(value, float) else ""
