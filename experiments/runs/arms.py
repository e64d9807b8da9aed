"""The arms of a comparison by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from experiments.baselines import CONTROLLERS, FILTERS
from experiments.runs.training_run import PolicyKind, RunResult
from shields.runtime.safety_filter import MODES

_SHIELD_MODES = tuple(mode for mode in MODES if mode != "monitor")
PENALTY_SUFFIX, RESIDUAL_SUFFIX, TEST_SUFFIX = "+penalty", "+residual", " at test"
_KNOWN_ARMS = (
    "unshielded, monitor, penalized, penalized:WEIGHT, lagrangian, FILTER, 'FILTER at test', FILTER+penalty, each also "
    "with +residual; CONTROLLER and CONTROLLER+FILTER, with FILTER one of shielded, shielded:MODE, "
    f"lookahead, {', '.join(FILTERS)} (modes: {', '.join(_SHIELD_MODES)}) and CONTROLLER one of untrained, "
    f"{', '.join(CONTROLLERS)}"
)

# Results of the training runs of each arm, in the order of their indices.
ResultsByArm = dict[str, Sequence[RunResult]]


@dataclass(frozen=True)
class Arm:
    """How the agents of an arm are trained and evaluated.

    Attributes:
        name: Name of the arm.
        mode: Mode of the shield, or name of another filter in `FILTERS`; None for neither.
        penalizes_interventions: Whether the training reward is reduced per intervention.
        penalizes_violations: Whether the training reward is reduced per violating step.
        policy: What acts: "trained" for a trained agent.
        violation_weight: Price of a violating step; None for that of the settings.
        adapts_penalty: Whether that price is adapted during training.
        filters_training: Whether shield or filter act in training too.
        is_residual: Whether the agent adds to the action of u = K x_hat.
    """

    name: str
    mode: str | None
    penalizes_interventions: bool = False
    penalizes_violations: bool = False
    policy: PolicyKind = "trained"
    violation_weight: float | None = None
    adapts_penalty: bool = False
    filters_training: bool = True
    is_residual: bool = False

    @classmethod
    def of(cls, name: str, mode: str = "project") -> Arm:
        """Returns the arm of a name, whose spaces may be given as hyphens.

        Args:
            name: Name of the arm on the command line.
            mode: Mode of the shield of arms that name none.

        Raises:
            ValueError: If the name is unknown.
        """
        spaced = name
        for words in (TEST_SUFFIX, *CONTROLLERS):
            spaced = spaced.replace(words.replace(" ", "-"), words)
        kind = spaced.removesuffix(RESIDUAL_SUFFIX)
        found = _controller(kind, mode) if kind == spaced else None
        found = found or _trained(kind, mode)
        if found is None:
            hint = " (several are separated by spaces)" if "," in name else ""
            raise ValueError(f"unknown arm {name!r}{hint}; known are {_KNOWN_ARMS}")
        return replace(found, name=spaced, is_residual=kind != spaced)

    @property
    def is_shielded(self) -> bool:
        """Whether a shield acts, and so a proof; a monitor only watches, and other filters prove nothing."""
        return is_shield(self.mode)

    @property
    def is_trained(self) -> bool:
        """Whether an agent is trained."""
        return self.policy == "trained"


def is_shield(mode: str | None) -> bool:
    """Returns whether a mode is one of the shield's that protects: not "monitor", and no other filter."""
    return mode in _SHIELD_MODES


def by_arm(results: Sequence[RunResult]) -> ResultsByArm:
    """Returns the results of each arm in the order of their runs."""
    names = dict.fromkeys(result.arm for result in results)
    return {name: sorted((r for r in results if r.arm == name), key=lambda r: r.index) for name in names}


def _controller(name: str, mode: str) -> Arm | None:
    """Returns the arm of a policy that is not trained, alone or behind a filter; None if this is no name of one."""
    for policy in (*CONTROLLERS, "untrained"):
        if name == policy:
            return Arm(name, None, policy=policy)  # type: ignore[arg-type]
        if name.startswith(f"{policy}+") and (own := _mode(name.removeprefix(f"{policy}+"), mode)) is not None:
            return Arm(name, own, policy=policy)  # type: ignore[arg-type]
    return None


def _trained(name: str, mode: str) -> Arm | None:
    """Returns the arm of a trained agent; None if this is no name of one."""
    if name in ("unshielded", "monitor"):
        return Arm(name, None if name == "unshielded" else "monitor")
    if name == "lagrangian":
        return Arm(name, None, penalizes_violations=True, adapts_penalty=True)
    kind, colon, weight = name.partition(":")
    if kind == "penalized":
        if colon and not _is_weight(weight):
            return None
        return Arm(name, None, penalizes_violations=True, violation_weight=float(weight) if colon else None)
    if name.endswith(TEST_SUFFIX):
        kind = name.removesuffix(TEST_SUFFIX)
        own = _mode("shielded" if kind == "shield" else kind, mode)
        return None if own is None else Arm(name, own, filters_training=False)
    kind = name.removesuffix(PENALTY_SUFFIX)
    own = _mode(kind, mode)
    return None if own is None else Arm(name, own, penalizes_interventions=kind != name)


def _mode(name: str, mode: str) -> str | None:
    """Returns the mode that the name of a filter stands for; None if this is no name of one."""
    if name in FILTERS or name == "lookahead":
        return name
    kind, colon, own = name.partition(":")
    if kind != "shielded" or (colon and own not in _SHIELD_MODES):
        return None
    return own or mode


def _is_weight(text: str) -> bool:
    """Returns whether a text is a number that a violating step may cost."""
    try:
        return 0.0 <= float(text) < float("inf")
    except ValueError:
        return False
