"""The unit of work: one policy, trained and evaluated; its result is a pure function of its settings."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from agents.agent import Agent
from agents.evaluation import Policy, evaluate
from agents.hyperparams import rollout_steps
from agents.loop import LoopConfig
from agents.results import Episode, TrainingPoint
from experiments.baselines.controllers import controller
from experiments.baselines.tuned import tuned_weights
from experiments.runs.loops import AS_TRAINED, import_module, under
from experiments.runs.provenance import module_digest, registration_of, versions
from experiments.settings import LearningSettings
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import counted
from shields import Certificate
from shields.documents import digest


@dataclass(frozen=True)
class RunResult:
    """Result of a training run, with the contents of the trained agent's files by name.

    Attributes:
        history: Running totals during the training.
        episodes: Evaluation episodes.
        scenarios: Evaluation episodes under other scenarios by name.
    """

    arm: str
    index: int
    train_steps: int
    train_violation_steps: int
    train_interventions: int
    history: list[TrainingPoint]
    episodes: list[Episode]
    files: dict[str, bytes] = field(default_factory=dict)
    scenarios: dict[str, list[Episode]] = field(default_factory=dict)

    @classmethod
    def of_json(cls, values: dict[str, Any]) -> RunResult:
        """Returns the result of what `dataclasses.asdict` made of it, without files."""
        episodes = [Episode(**each) for each in values["episodes"]]
        history = [TrainingPoint(**each) for each in values["history"]]
        scenarios = {name: [Episode(**each) for each in played] for name, played in values["scenarios"].items()}
        return cls(**values | {"episodes": episodes, "history": history, "scenarios": scenarios})

    @property
    def outcome(self) -> str:
        """What came out, in one line."""
        violating = sum(episode.violation_steps > 0 for episode in self.episodes)
        mean = sum(episode.episode_return for episode in self.episodes) / len(self.episodes)
        training = f"{self.train_violation_steps:,} violating training steps, " if self.train_steps else ""
        which = "on its channel " if self.scenarios else ""
        return f"{training}{which}{violating} of {counted(len(self.episodes), 'episode')} violating, return {mean:z.2f}"


@dataclass(frozen=True, kw_only=True)
class TrainingRun:
    """Settings of one training run.

    Attributes:
        policy_kind: "trained" is a trained agent; "untrained" an agent with its initial weights; "pretrained" the one
            that comes with the package, in `agent_files`; the others are controllers (`experiments.baselines`).
        training_loop: Control loop that the policy is trained in, with its penalties.
        loop: Control loop that the policy is evaluated in.
        module: Module of the user's that registers the environment, imported where the run is executed.
        index: Number of the run within its arm; runs with equal index are paired across arms.
        certificate: Certificate of shield or filter, which also defines `times_safe_set` and the gain of controllers.
        scenarios: Further scenarios that the policy is evaluated under.
        algorithm: A name in `agents.hyperparams.ALGORITHMS`.
        settings: Its hyperparameters.
        grid_point: Name of the point of a sweep's grid; part of the run's name only.
        agent_files: Files of an agent that was trained before: it is evaluated, and nothing is trained.
    """

    arm: str
    policy_kind: str
    training_loop: LoopConfig
    loop: LoopConfig
    module: str = ""
    seed: int
    index: int
    steps: int
    episodes: int
    certificate: Certificate
    scenarios: tuple[str, ...] = ()
    algorithm: str
    settings: dict[str, Any]
    grid_point: str = ""
    agent_files: dict[str, bytes] = field(default_factory=dict)

    @property
    def trains(self) -> bool:
        """Whether an agent is trained."""
        return self.policy_kind == "trained" and not self.agent_files

    @property
    def name(self) -> str:
        """Name in file names and progress lines."""
        return "-".join(filter(None, (self.grid_point, self.arm, str(self.index)))).replace(" ", "-").replace(":", "-")

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
        """SHA-256 of all that the result depends on: settings, environment, source, versions of packages."""
        certificate = self.certificate.checksum
        content = {name: value for name, value in vars(self).items() if name not in ("certificate", "grid_point")}
        content |= {
            "module": module_digest(self.module),
            "environment": registration_of(self.loop.env),
            "certificate": certificate,
            "training_loop": _described(self.training_loop, certificate),
            "loop": _described(self.loop, certificate),
            "agent_files": {name: hashlib.sha256(file).hexdigest() for name, file in self.agent_files.items()},
        }
        return digest(content | {"versions": versions()})

    @property
    def total_steps(self) -> int:
        """Training steps, in whole rollouts, and evaluation steps."""
        evaluation = self.episodes * (self.loop.episode_steps or 1) * (1 + len(self.scenarios))
        if not self.trains:
            return evaluation
        rollout = rollout_steps(self.algorithm, self.settings)
        return -(-self.steps // rollout) * rollout + evaluation

    def execute(self, on_progress: Callable[[int], None], log_folder: Path | None = None) -> RunResult:
        """Returns the result; only TensorBoard's events are written."""
        if self.module:
            import_module(self.module)
        agent, counts, history, files = None, (0, 0, 0), [], {}
        if self.trains:
            from agents import train  # imports torch, which the process that collects results does without

            logs = log_folder and log_folder / self.name
            if logs is not None:
                shutil.rmtree(logs, ignore_errors=True)
            given = self.training_loop, self.steps, self.training_seed, self.algorithm, self.settings
            trained = train(*given, log_folder=logs, on_progress=on_progress)
            counts = trained.steps, trained.violation_steps, trained.interventions
            agent, history, files = trained.agent, trained.history, trained.agent.files()
        elif self.agent_files:
            agent = Agent.of_files(self.agent_files)
        elif self.policy_kind == "untrained":
            from agents import untrained

            agent = untrained(self.loop, self.training_seed, self.algorithm, self.settings)
        safe_set, played = self.certificate.safe_set, {}
        for name in (AS_TRAINED, *self.scenarios):
            loop, policy = under(name, self.loop), _policy(self, agent)  # a random policy begins anew each time
            found = evaluate(loop, policy, self.episodes, self.evaluation_seed, safe_set, on_progress)
            played[name] = found.episodes
        own = played.pop(AS_TRAINED)
        return RunResult(self.arm, self.index, *counts, history, own, files=files, scenarios=played)

    def _seeds(self) -> list[int]:
        """Returns two 31-bit numbers that depend on the experiment's seed and the run's index, not on the arm."""
        return [int(word >> 1) for word in np.random.SeedSequence([self.seed, self.index]).generate_state(2)]


def _described(loop: LoopConfig, certificate: str) -> dict[str, Any]:
    """Returns a control loop as JSON values, with the checksum of its certificate."""
    values = dict(vars(loop))
    for name in ("shield", "filter"):
        values[name] = values[name] and vars(values[name]) | {"certificate": certificate}
    for name in ("observed", "lagrangian"):
        values[name] = values[name] and [type(values[name]).__name__, vars(values[name])]
    return values


def _policy(run: TrainingRun, agent: Agent | None) -> Policy:
    """Returns what acts in the evaluation of a run: an agent, or without one a controller that begins anew."""
    if agent is not None:
        return lambda observations, infos: agent.act(observations)
    env, fallback, weights = ncs_env(run.loop.single()), run.certificate.fallback, tuned_weights(run.loop.env, run.arm)
    return controller(run.policy_kind, env, fallback, run.evaluation_seed, weights)


def require_trainable(settings: LearningSettings, loop: LoopConfig) -> None:
    """Raises ValueError if agents cannot be trained with the hyperparameters given."""
    if settings.hyperparams or loop.lagrangian is not None:
        from agents import training  # imports torch

        training.require_trainable(loop, settings.training_steps, settings.algorithm, settings.all_hyperparams)
