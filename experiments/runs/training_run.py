"""The unit of work: one policy, trained and evaluated; its result is a pure function of its settings."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from agents.control_loop import ControlLoop, ShieldSettings
from agents.evaluation import evaluate
from agents.results import Episode, TrainingPoint, Trajectory
from agents.settings import AgentSettings, LagrangianSettings, OffPolicySettings
from experiments.baselines import FILTERS, filtered
from experiments.runs.environments import import_module, module_digest
from experiments.runs.evaluation_conditions import AS_TRAINED, under
from experiments.runs.policies import agent_of, vector_policy
from experiments.runs.provenance import json_digest, versions
from ncs_gym import Channel
from ncs_gym.envs.env import ncs_env
from shields import Certificate

PolicyKind = Literal["trained", "untrained", "zero input", "K x_hat", "random", "proportional", "lqr"]


@dataclass(frozen=True, kw_only=True)
class TrainingRun:
    """Settings of one training run.

    Attributes:
        arm: Name of the arm that the run belongs to.
        policy_kind: "trained" is a trained agent; "untrained" an agent with its initial weights; the others are
            controllers (`experiments.baselines.CONTROLLERS`).
        env: Id of a registered environment.
        module: Module of the user's that registers it, imported where the run is executed; empty for none.
        channel: Channel that replaces the environment's own; None keeps it.
        downlink: Channel that replaces the environment's own downlink; None keeps it.
        noise: "truncated", or "gaussian" for noise without a bound.
        process: Fields of the process that replace the environment's own, JSON values; None keeps it.
        seed: Seed of the experiment.
        index: Number of the run within its arm; runs with equal index are paired across arms.
        steps: Training steps.
        episodes: Evaluation episodes.
        certificate: Certificate of the shield, which also defines x'Mx.
        certificate_basis: What the certificate was synthesized from, in words; empty for one that was given. Its last
            digits may depend on the machine, and a run that another machine finished is still the same run.
        mode: Mode of the shield, or name of another filter; None for neither.
        horizon: Longest plan of modes that look ahead [steps]; None in other modes, and for the default.
        filters_training: Whether shield or filter act in training too.
        intervention_penalty: Subtracted from the training reward per intervention.
        violation_penalty: Subtracted from the training reward per violating step.
        lagrangian: How that penalty is adapted during training; None for a fixed one.
        is_residual: Whether the agent adds to the action of u = K x_hat.
        conditions: Conditions that the policy is evaluated under besides that of its training.
        algorithm: Name of the learning algorithm, a key of `agents.algorithms`.
        settings: Settings of the learning algorithm.
        grid_point: Name of the point of a sweep's grid; part of the run's name only.
        agent_files: Files of an agent that was trained before: it is evaluated, and nothing is trained. Empty for none.
    """

    arm: str
    policy_kind: PolicyKind
    env: str
    module: str = ""
    channel: Channel | None = None
    downlink: Channel | None = None
    noise: str = "truncated"
    process: dict[str, Any] | None = None
    seed: int
    index: int
    steps: int
    episodes: int
    certificate: Certificate
    certificate_basis: str = ""
    mode: str | None
    horizon: int | None = None
    filters_training: bool = True
    intervention_penalty: float = 0.0
    violation_penalty: float = 0.0
    lagrangian: LagrangianSettings | None = None
    is_residual: bool = False
    conditions: tuple[str, ...] = ()
    algorithm: str
    settings: AgentSettings
    grid_point: str = ""
    agent_files: dict[str, bytes] = field(default_factory=dict)

    @property
    def trains(self) -> bool:
        """Whether an agent is trained in this run."""
        return self.policy_kind == "trained" and not self.agent_files

    @property
    def name(self) -> str:
        """Name of the run in file names and progress lines."""
        return "-".join(filter(None, (self.grid_point, self.arm, str(self.index)))).replace(" ", "-").replace(":", "-")

    @property
    def loop(self) -> ControlLoop:
        """Control loop that the policy is evaluated in, with the penalties of its training."""
        shield, wrapper = None, None
        if self.mode in FILTERS:
            own = {"certificate": self.certificate, "penalty": self.intervention_penalty, "horizon": self.horizon}
            wrapper = partial(filtered, name=self.mode, **own)
        elif self.mode is not None:
            shield = ShieldSettings(self.certificate, self.mode, self.intervention_penalty, self.horizon)
        return ControlLoop(
            env=self.env,
            channel=self.channel,
            downlink=self.downlink,
            shield=shield,
            filter=wrapper,
            violation_penalty=self.violation_penalty,
            noise=self.noise,
            process=self.process,
            lagrangian=self.lagrangian,
        )

    @property
    def training_loop(self) -> ControlLoop:
        """Control loop that the policy is trained in."""
        loop = self.loop if self.filters_training else replace(self.loop, shield=None, filter=None)
        if not self.is_residual:
            return loop
        return replace(loop, residual_gain=self.certificate.K / ncs_env(loop.single()).plant.u_max[:, None])

    @property
    def training_seed(self) -> int:
        """Seed of the training environments and of the networks; the same in all arms."""
        return self._seeds()[0]

    @property
    def evaluation_seed(self) -> int:
        """Seed of the evaluation episodes; the same in all arms."""
        return self._seeds()[1]

    @property
    def key(self) -> str:
        """SHA-256 of everything the result depends on: all settings, this project's source and versions of packages."""
        names = set(self.__dataclass_fields__) - {"certificate", "certificate_basis", "grid_point", "module"}
        content = {name: getattr(self, name) for name in names}
        content |= {
            "module": module_digest(self.module),
            "certificate": self.certificate_basis or self.certificate.checksum,
            "channel": self.channel and asdict(self.channel),
            "downlink": self.downlink and asdict(self.downlink),
            "lagrangian": self.lagrangian and asdict(self.lagrangian),
            "agent_files": {name: hashlib.sha256(file).hexdigest() for name, file in self.agent_files.items()},
        }
        return json_digest(content | {"settings": asdict(self.settings), "versions": versions()})

    @property
    def total_steps(self) -> int:
        """Training steps, in whole rollouts, and evaluation steps."""
        evaluation = self.episodes * (gym.spec(self.env).max_episode_steps or 1) * (1 + len(self.conditions))
        if not self.trains:
            return evaluation
        steps_per_env = 1 if isinstance(self.settings, OffPolicySettings) else self.settings.rollout
        rollout = self.settings.envs * steps_per_env
        return -(-self.steps // rollout) * rollout + evaluation

    def _seeds(self) -> list[int]:
        """Returns two 31-bit numbers that depend on the experiment's seed and the run's index, not on the arm."""
        return [int(word >> 1) for word in np.random.SeedSequence([self.seed, self.index]).generate_state(2)]


@dataclass(frozen=True)
class RunResult:
    """Result of a training run.

    Attributes:
        arm: Name of the run's arm.
        index: Number of the run within its arm.
        train_steps: Number of training steps; 0 if nothing was trained.
        train_violation_steps: Number of training steps whose true state violated the safe box.
        train_interventions: Number of training steps in which the shield intervened.
        history: Running totals during the training.
        episodes: Evaluation episodes.
        trajectory: Trajectory of the first evaluation episode.
        files: Contents of the trained agent's files by name; empty if nothing was trained.
        conditions: Evaluation episodes under other conditions than that of the training, by the condition's name.
    """

    arm: str
    index: int
    train_steps: int
    train_violation_steps: int
    train_interventions: int
    history: list[TrainingPoint]
    episodes: list[Episode]
    trajectory: Trajectory
    files: dict[str, bytes]
    conditions: dict[str, list[Episode]] = field(default_factory=dict)


def execute_run(run: TrainingRun, on_progress: Callable[[int], None], log_folder: Path | None = None) -> RunResult:
    """Returns the result of a training run; only TensorBoard's events are written.

    Args:
        run: Settings of the run.
        on_progress: Called with the number of training and evaluation steps taken since its last call.
        log_folder: Folder of TensorBoard's events; earlier events in it are removed.
    """
    if run.module:
        import_module(run.module)
    trained = None
    if run.trains:
        from agents.training import train  # imports torch, which the process that only collects results does without

        if log_folder is not None:
            shutil.rmtree(log_folder, ignore_errors=True)
        trained = train(
            run.training_loop,
            run.steps,
            run.training_seed,
            run.algorithm,
            run.settings,
            log_folder=log_folder,
            on_progress=on_progress,
        )
    agent = trained.agent if trained else agent_of(run)
    evaluations = {}
    for condition in (AS_TRAINED, *run.conditions):
        loop, policy = under(condition, run.loop), vector_policy(run, agent)  # a random policy begins anew each time
        evaluations[condition] = evaluate(
            loop, policy, run.episodes, run.evaluation_seed, run.certificate.M, on_progress
        )
    evaluation = evaluations.pop(AS_TRAINED)
    return RunResult(
        arm=run.arm,
        index=run.index,
        train_steps=trained.steps if trained else 0,
        train_violation_steps=trained.violation_steps if trained else 0,
        train_interventions=trained.interventions if trained else 0,
        history=trained.history if trained else [],
        episodes=evaluation.episodes,
        trajectory=evaluation.trajectory,
        files=trained.agent.files() if trained else {},
        conditions={condition: each.episodes for condition, each in evaluations.items()},
    )
