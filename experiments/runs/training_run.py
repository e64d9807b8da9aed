"""The unit of work: one policy trained and evaluated; a pure function of its settings."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from agents.control_loop import ControlLoop, Shielding
from agents.evaluation import Episode, Policy, evaluate
from agents.history import TrainingPoint
from agents.settings import AgentSettings
from agents.trajectory import Trajectory
from experiments.runs.provenance import versions
from ncs_gym import Channel
from ncs_gym.envs.env import ncs_env
from shields import Certificate

if TYPE_CHECKING:
    from agents.training import TrainingResult

Learner = Literal["agent", "untrained", "gain", "zero"]


@dataclass(frozen=True, kw_only=True)
class Unit:
    """Settings of one unit.

    Attributes:
        arm: Name of the arm it belongs to.
        learner: "agent" is trained; "untrained" has its initial weights, "gain" is u = K x_hat, "zero" does nothing.
        env: A registered id.
        channel: In place of the environment's own.
        seed: Of the experiment.
        index: Number of the run within its arm; runs with equal index are paired across arms.
        steps: Training steps.
        episodes: Evaluation episodes.
        certificate: For the shield and for x'Mx.
        mode: The shield's; None for no shield.
        intervention_penalty: Subtracted from the training reward per intervention.
        violation_penalty: Subtracted from the training reward per violating step.
        algorithm: A name in `agents.algorithms`.
        settings: Of the algorithm.
        place: Where in a sweep it belongs; for its name only.
    """

    arm: str
    learner: Learner
    env: str
    channel: Channel | None = None
    seed: int
    index: int
    steps: int
    episodes: int
    certificate: Certificate
    mode: str | None
    intervention_penalty: float = 0.0
    violation_penalty: float = 0.0
    algorithm: str
    settings: AgentSettings
    place: str = ""

    @property
    def name(self) -> str:
        """For files and progress lines."""
        return "-".join(filter(None, (self.place, self.arm, str(self.index)))).replace(" ", "-").replace(":", "-")

    @property
    def loop(self) -> ControlLoop:
        """What the policy is trained and evaluated in."""
        shielding = None
        if self.mode is not None:
            shielding = Shielding(self.certificate, self.mode, self.intervention_penalty)
        return ControlLoop(
            env=self.env, channel=self.channel, shielding=shielding, violation_penalty=self.violation_penalty
        )

    @property
    def training_seed(self) -> int:
        """Seed of training environments and network; alike in all arms."""
        return self._seeds()[0]

    @property
    def evaluation_seed(self) -> int:
        """Seed of the evaluation episodes; alike in all arms."""
        return self._seeds()[1]

    @property
    def key(self) -> str:
        """SHA-256 of everything the result depends on: all settings, this project's source and versions of packages."""
        content = {
            name: getattr(self, name) for name in self.__dataclass_fields__ if name not in ("certificate", "place")
        }
        content |= {"certificate": self.certificate.checksum, "channel": self.channel and asdict(self.channel)}
        content |= {"settings": asdict(self.settings), "versions": versions()}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def _seeds(self) -> list[int]:
        """Returns two 31-bit numbers that depend on the experiment's seed and the run, not on the arm."""
        return [int(word >> 1) for word in np.random.SeedSequence([self.seed, self.index]).generate_state(2)]


@dataclass(frozen=True)
class UnitResult:
    """What a unit leaves.

    Attributes:
        arm, index: The unit's.
        train_steps: Steps of training (0 if nothing was trained).
        train_violation_steps: Of these, steps whose true state violated the safe box.
        train_interventions: Of these, steps in which the shield intervened.
        history: Totals along the way.
        episodes: Evaluation.
        trajectory: The first evaluation episode.
        files: The trained agent's files, contents by name; empty if nothing was trained.
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


def run_unit(unit: Unit, on_progress: Callable[[int], None], log_folder: Path | None = None) -> UnitResult:
    """Returns the result of a unit; nothing is written but TensorBoard's events.

    Args:
        unit: The settings.
        on_progress: Called with the number of training and evaluation steps taken since its last call.
        log_folder: Where TensorBoard's events go; earlier ones there are removed.
    """
    trained = None
    if unit.learner == "agent":
        from agents.training import train  # torch, which the process that only collects results does without

        if log_folder is not None:
            shutil.rmtree(log_folder, ignore_errors=True)
        trained = train(
            unit.loop,
            unit.steps,
            unit.training_seed,
            unit.algorithm,
            unit.settings,
            log_folder=log_folder,
            on_progress=on_progress,
        )
    policy = _policy(unit, trained)
    evaluation = evaluate(unit.loop, policy, unit.episodes, unit.evaluation_seed, unit.certificate.M, on_progress)
    return UnitResult(
        arm=unit.arm,
        index=unit.index,
        train_steps=trained.steps if trained else 0,
        train_violation_steps=trained.violation_steps if trained else 0,
        train_interventions=trained.interventions if trained else 0,
        history=trained.history if trained else [],
        episodes=evaluation.episodes,
        trajectory=evaluation.trajectory,
        files=trained.agent.files() if trained else {},
    )


def _policy(unit: Unit, trained: TrainingResult | None) -> Policy:
    """Returns the policy to evaluate."""
    if trained is not None:
        return lambda observations, infos: trained.agent.act(observations)
    plant = ncs_env(unit.loop.single()).plant
    if unit.learner == "untrained":
        from agents.training import untrained

        agent = untrained(unit.loop, unit.training_seed, unit.algorithm, unit.settings)
        return lambda observations, infos: agent.act(observations)
    if unit.learner == "gain":
        gain = unit.certificate.K / plant.u_max[:, None]
        return lambda observations, infos: np.clip(infos["estimate"] @ gain.T, -1.0, 1.0)
    return lambda observations, infos: np.zeros((len(observations), plant.m), np.float32)
