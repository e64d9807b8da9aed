"""The arms of a comparison by name."""

from __future__ import annotations

from dataclasses import dataclass

MODES = ("project", "switch", "boundary")
PENALTY = "+penalty"
NAMES = "unshielded, monitor, penalized, shielded, shielded:MODE, each shielded one also with +penalty"


@dataclass(frozen=True)
class Arm:
    """How agents of an arm are trained and evaluated.

    Attributes:
        name: As the user writes it.
        mode: Of the shield; None for none.
        prices_interventions: Whether the reward is less by a penalty per intervention.
        prices_violations: Whether it is less by a penalty per violating step.
    """

    name: str
    mode: str | None
    prices_interventions: bool = False
    prices_violations: bool = False


def arm_of(name: str, mode: str) -> Arm:
    """Returns the arm of a name; "shielded" without a mode of its own takes `mode`.

    Raises:
        ValueError: If the name is unknown.
    """
    if name in ("unshielded", "penalized"):
        return Arm(name, None, prices_violations=name == "penalized")
    if name == "monitor":
        return Arm(name, "monitor")
    kind, _, own = name.removesuffix(PENALTY).partition(":")
    if kind != "shielded" or (":" in name and own not in MODES):
        raise ValueError(f"unknown arm {name!r}; known are {NAMES} (modes: {', '.join(MODES)})")
    return Arm(name, own or mode, prices_interventions=name.endswith(PENALTY))
