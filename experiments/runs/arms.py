"""The arms of a comparison by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from experiments.runs.training_run import RunResult

_SHIELD_MODES = ("project", "switch", "boundary")
PENALTY_SUFFIX = "+penalty"
_KNOWN_ARMS = "unshielded, monitor, penalized, shielded, shielded:MODE, each shielded one also with +penalty"

# Results of the training runs of each arm, in the order of their indices.
ResultsByArm = dict[str, Sequence[RunResult]]


@dataclass(frozen=True)
class Arm:
    """How the agents of an arm are trained and evaluated.

    Attributes:
        name: Name of the arm on the command line.
        mode: Mode of the shield; None for no shield.
        penalizes_interventions: Whether the training reward is reduced per intervention.
        penalizes_violations: Whether the training reward is reduced per violating step.
    """

    name: str
    mode: str | None
    penalizes_interventions: bool = False
    penalizes_violations: bool = False

    @classmethod
    def of(cls, name: str, mode: str = "project") -> Arm:
        """Returns the arm of a name.

        Args:
            name: Name of the arm on the command line.
            mode: Mode of the shield of arms that name none.

        Raises:
            ValueError: If the name is unknown.
        """
        if name in ("unshielded", "penalized"):
            return cls(name, None, penalizes_violations=name == "penalized")
        if name == "monitor":
            return cls(name, "monitor")
        kind, _, own_mode = name.removesuffix(PENALTY_SUFFIX).partition(":")
        if kind != "shielded" or (":" in name and own_mode not in _SHIELD_MODES):
            raise ValueError(f"unknown arm {name!r}; known are {_KNOWN_ARMS} (modes: {', '.join(_SHIELD_MODES)})")
        return cls(name, own_mode or mode, penalizes_interventions=name.endswith(PENALTY_SUFFIX))

    @property
    def is_shielded(self) -> bool:
        """Whether a shield acts; a monitor only watches."""
        return self.mode not in (None, "monitor")


def by_arm(results: Sequence[RunResult]) -> ResultsByArm:
    """Returns the results of each arm in the order of their runs."""
    names = dict.fromkeys(result.arm for result in results)
    return {name: sorted((r for r in results if r.arm == name), key=lambda r: r.index) for name in names}
