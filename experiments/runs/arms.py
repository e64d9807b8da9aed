"""The arms of a comparison: one table of names, and what each makes of a control loop."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from math import inf

from agents.agent import AGENT_FILES, pretrained_folder
from agents.hyperparams import ALGORITHMS, with_changes
from agents.loop import LoopConfig, ShieldSettings
from experiments.baselines.controllers import CONTROLLERS, REGULATORS, why_aimless
from experiments.baselines.filters import FILTERS, EstimateFilterSettings
from experiments.baselines.tuned import tuned_training
from experiments.runs.loops import other_scenarios, registered_env, under
from experiments.runs.policies import PRETRAINED
from experiments.runs.training_run import RunResult, TrainingRun, require_trainable
from experiments.settings import LearningSettings
from shields import Certificate
from shields.runtime.safety_filter import MODES

_SHIELD_MODES = tuple(mode for mode in MODES if mode != "monitor")
# What acts where no agent is trained.
_POLICIES = (*CONTROLLERS, *REGULATORS, "untrained", PRETRAINED)
_KNOWN_ARMS = (
    "unshielded, monitor, penalized[:WEIGHT], lagrangian[:LIMIT], FILTER, FILTER+penalty, 'FILTER at test', POLICY and "
    f"POLICY+FILTER, with FILTER one of shielded[:MODE], lookahead, {', '.join(FILTERS)} and POLICY one of "
    f"{', '.join(_POLICIES)} (modes: {', '.join(_SHIELD_MODES)})"
)

# Arms whose name may have a weight, and what it is.
_WEIGHTED = {"penalized": "violation_weight", "lagrangian": "cost_limit"}

# Results of the training runs of each arm, in the order of their indices.
ResultsByArm = dict[str, Sequence[RunResult]]


@dataclass(frozen=True)
class Arm:
    """How the agents of an arm are trained and evaluated.

    Attributes:
        name: Its full name.
        mode: Mode of the shield, or name of another filter in `FILTERS`; None for neither.
        policy: What acts: "trained" for a trained agent.
        penalizes_interventions: Whether the training reward is reduced per intervention.
        penalizes_violations: Whether the training reward is reduced per violating step.
        violation_weight: Price of a violating step; None for that of the settings.
        adapts_penalty: Whether that price is adapted during training.
        cost_limit: Of PPO-Lagrangian; None for that of the settings.
        filters_training: Whether shield or filter act in training too.
        algorithm: Algorithm that trains the agents, the first word of the name; empty for that of the settings.
    """

    name: str
    mode: str | None = None
    policy: str = "trained"
    penalizes_interventions: bool = False
    penalizes_violations: bool = False
    violation_weight: float | None = None
    adapts_penalty: bool = False
    cost_limit: float | None = None
    filters_training: bool = True
    algorithm: str = ""

    @classmethod
    def of(cls, name: str, mode: str = "project") -> Arm:
        """Returns the arm of a name, whose spaces may be given as hyphens; raises ValueError if it is unknown."""
        table, spaced = _table(mode), name.replace("-", " ")
        if spaced in table:
            return table[spaced]
        first = spaced.partition(" ")[0]
        if first in ALGORITHMS and (arm := cls.of(name[len(first) + 1 :], mode)).is_trained and not arm.algorithm:
            return replace(arm, name=f"{first} {arm.name}", algorithm=first)
        kind, _, weight = name.partition(":")
        if kind in _WEIGHTED:
            with suppress(ValueError):
                if 0.0 <= (value := float(weight)) < inf:
                    return replace(table[kind], name=name, **{_WEIGHTED[kind]: value})
        raise ValueError(f"unknown arm {name!r}; known are {_KNOWN_ARMS}")

    @property
    def is_trained(self) -> bool:
        """Whether an agent is trained."""
        return self.policy == "trained"

    @property
    def differs_from_run_to_run(self) -> bool:
        """Whether runs have different policies, as trained and untrained agents do; others are the same in all."""
        return self.policy in ("trained", "untrained")

    def loops(
        self, loop: LoopConfig, certificate: Certificate, settings: LearningSettings
    ) -> tuple[LoopConfig, LoopConfig]:
        """Returns the control loops that the arm's policies are trained and evaluated in, given the bare one."""

        def filtered(penalty: float = 0.0) -> LoopConfig:
            if self.mode is None:
                return loop
            if self.mode in FILTERS:
                return replace(loop, filter=EstimateFilterSettings(self.mode, certificate, penalty))
            horizon = settings.horizon if self.mode == "lookahead" else None
            return replace(loop, shield=ShieldSettings(certificate, self.mode, penalty, horizon, on_unproved="ignore"))

        training = filtered(settings.intervention_penalty * self.penalizes_interventions)
        if not self.filters_training:
            training = loop
        if self.adapts_penalty:
            limit = settings.lagrangian.cost_limit if self.cost_limit is None else self.cost_limit
            training = replace(training, lagrangian=replace(settings.lagrangian, cost_limit=limit))
        elif self.penalizes_violations:
            given = self.violation_weight
            training = replace(training, violation_penalty=settings.violation_penalty if given is None else given)
        return training, filtered()


def full_names(names: Sequence[str], settings: LearningSettings) -> tuple[str, ...]:
    """Returns the full names of arms, under which results are kept; several algorithms have an arm each."""
    found: list[str] = []
    for arm in (Arm.of(name, settings.mode) for name in names):
        several = len(settings.algorithms) > 1 and arm.is_trained and not arm.algorithm
        found += [f"{each} {arm.name}" for each in settings.algorithms] if several else [arm.name]
    return tuple(found)


def is_shield(mode: str | None) -> bool:
    """Returns whether a shield of this mode proves something: a monitor only watches, other filters prove nothing."""
    return mode in _SHIELD_MODES


def by_arm(results: Sequence[RunResult]) -> ResultsByArm:
    """Returns the results of each arm in the order of their runs."""
    names = dict.fromkeys(result.arm for result in results)
    return {name: sorted((r for r in results if r.arm == name), key=lambda r: r.index) for name in names}


@cache
def _table(mode: str) -> dict[str, Arm]:
    """Returns the arms of one algorithm by name, but for weights in names; `mode` is that of "shielded"."""
    filters = {"shielded": mode, "lookahead": "lookahead"} | {f"shielded:{each}": each for each in _SHIELD_MODES}
    filters |= {each: each for each in FILTERS}
    arms = [Arm("unshielded"), Arm("monitor", "monitor"), Arm("penalized", penalizes_violations=True)]
    arms += [Arm("lagrangian", penalizes_violations=True, adapts_penalty=True)]
    arms += [Arm("shield at test", mode, filters_training=False), *(Arm(each, policy=each) for each in _POLICIES)]
    for name, applied in filters.items():
        arms += [Arm(name, applied), Arm(f"{name} at test", applied, filters_training=False)]
        arms += [Arm(f"{name}+penalty", applied, penalizes_interventions=True)]
        arms += [Arm(f"{each}+{name}", applied, each) for each in _POLICIES]
    return {arm.name: arm for arm in arms}


def require_arms(settings: LearningSettings, loop: LoopConfig, names: Sequence[str]) -> None:
    """Raises what arms cannot do in an environment, as far as that is known without a certificate.

    Raises:
        ValueError: If an arm or a scenario is unknown or impossible, or the hyperparameters train nothing.
    """
    for each in settings.by_algorithm:
        require_trainable(each, loop)
    task = registered_env(loop.env).task
    for arm in (Arm.of(name, settings.mode) for name in names):
        if arm.algorithm and (len(settings.algorithms) == 1 or arm.algorithm not in settings.algorithms):
            raise ValueError(f"arm {arm.name}: {arm.algorithm} must be one of several in --algorithms")
        if problem := why_aimless(arm.policy, task):
            raise ValueError(f"arm {arm.name}: {problem}")
    for scenario in other_scenarios(getattr(settings, "scenarios", ())):
        try:
            under(scenario, loop).single().close()
        except ValueError as error:
            raise ValueError(f"--scenarios {scenario}: {error}") from None


def is_any_trained(settings: LearningSettings, names: Sequence[str]) -> bool:
    """Returns whether an agent is trained in any of these arms."""
    return any(Arm.of(name, settings.mode).is_trained for name in names)


def run_of_arm(
    settings: LearningSettings,
    loop: LoopConfig,
    certificate: Certificate,
    arm_name: str,
    index: int,
    grid_point: str = "",
) -> TrainingRun:
    """Returns one run of an arm.

    Raises:
        ValueError: If the arm or a scenario is unknown.
        AgentError: If the arm is the pretrained agent's, and the package has none for the environment.
    """
    arm = Arm.of(arm_name, settings.mode)
    if arm.algorithm:
        settings = replace(settings, algorithms=(arm.algorithm,))
    hyperparams = settings.all_hyperparams
    if arm.is_trained and getattr(settings, "tuned_arms", False):
        own = dict(tuned_training(loop.env, "lagrangian" if arm.adapts_penalty else arm.name))
        hyperparams = with_changes(hyperparams, own.pop("hyperparams", {}))
        if "lagrangian" in own:
            own["lagrangian"] = replace(settings.lagrangian, **own["lagrangian"])
        settings = replace(settings, **own)
    agent_files = {}
    if arm.policy == PRETRAINED:  # its checksums are verified where it acts
        folder = pretrained_folder(loop.env)
        agent_files = {name: (folder / name).read_bytes() for name in AGENT_FILES}
    training_loop, loop = arm.loops(loop, certificate, settings)
    if index == 0:  # what cannot be made is refused before anything is trained
        if arm.is_trained:
            require_trainable(settings, training_loop)
        if arm.mode in FILTERS:
            try:
                loop.vector(1).close()
            except ValueError as error:
                raise ValueError(f"arm {arm.name}: {error}") from None
    return TrainingRun(
        arm=arm.name,
        policy_kind=arm.policy,
        training_loop=training_loop,
        loop=loop,
        module=settings.env.rpartition(":")[0],
        seed=settings.seed,
        index=index,
        steps=settings.training_steps,
        episodes=settings.episodes,
        certificate=certificate,
        scenarios=other_scenarios(getattr(settings, "scenarios", ())),
        algorithm=settings.algorithm,
        settings=hyperparams,
        grid_point=grid_point,
        agent_files=agent_files,
    )
