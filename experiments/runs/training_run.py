"""The unit of work: one policy, trained and evaluated; its result is a pure function of its settings."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.agent_file import AGENT_FILES, write_files
from agents.evaluation import Policy, evaluate
from agents.hyperparams import rollout_steps
from agents.loop import LoopConfig
from agents.results import Episode, TrainingPoint, Trajectory
from experiments.baselines import controller, tuned_weights
from experiments.json_values import to_json
from experiments.runs.loops import AS_TRAINED, import_module, module_digest, under
from experiments.runs.provenance import versions
from experiments.settings import LearningSettings
from experiments.settings.arguments import registration_of
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import LARGEST_NUMBER, counted, shown
from shields import Certificate
from shields.json_documents import digest

if TYPE_CHECKING:
    from agents.agent import Agent

# Folder of a run's checkpoints below that of its events.
CHECKPOINT = "checkpoint"
# Counts are numbers that floats and tables hold exactly.
_LARGEST_COUNT = 2**53


@dataclass(frozen=True)
class Start:
    """An agent that a training goes on from, and what happened in its training.

    Attributes:
        files: Files of the agent.
        history: Totals of its training, one point at least.
    """

    files: dict[str, bytes]
    history: list[TrainingPoint]

    @property
    def steps(self) -> int:
        """Steps that the agent was trained for."""
        return self.history[-1].steps


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
        scenarios: Evaluation episodes under other scenarios than that of the training, by the scenario's name.
    """

    arm: str
    index: int
    train_steps: int
    train_violation_steps: int
    train_interventions: int
    history: list[TrainingPoint]
    episodes: list[Episode]
    trajectory: Trajectory
    files: dict[str, bytes] = field(default_factory=dict)
    scenarios: dict[str, list[Episode]] = field(default_factory=dict)

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
        arm: Name of the arm that the run belongs to.
        policy_kind: "trained" is a trained agent; "untrained" an agent with its initial weights; "pretrained" the one
            that comes with the package, in `agent_files`; the others are
            controllers (`experiments.baselines.CONTROLLERS` and `REGULATORS`).
        training_loop: Control loop that the policy is trained in, with its penalties.
        loop: Control loop that the policy is evaluated in.
        module: Module of the user's that registers the environment, imported where the run is executed; empty for none.
        seed: Seed of the experiment.
        index: Number of the run within its arm; runs with equal index are paired across arms.
        steps: Training steps.
        episodes: Evaluation episodes.
        certificate: Certificate of shield or filter, which also defines x'Mx and the gain of controllers.
        certificate_basis: What the certificate was synthesized from, in words; empty for one that was given. Its last
            digits may depend on the machine, and a run that another machine finished is still the same run.
        scenarios: Scenarios that the policy is evaluated under besides that of its training.
        algorithm: Name of the learning algorithm, one of `agents.hyperparams.ALGORITHMS`.
        settings: Hyperparameters of the learning algorithm.
        grid_point: Name of the point of a sweep's grid; part of the run's name only.
        agent_files: Files of an agent that was trained before: it is evaluated, and nothing is trained. Empty for none.
        start: What the training goes on from; None for one that begins.
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
    certificate_basis: str = ""
    scenarios: tuple[str, ...] = ()
    algorithm: str
    settings: dict[str, Any]
    grid_point: str = ""
    agent_files: dict[str, bytes] = field(default_factory=dict)
    start: Start | None = None

    result_type = RunResult
    unit = "step"

    @property
    def parts(self) -> tuple[str, ...]:
        """What the steps belong to."""
        return ("training", "evaluation") if self.trains else ("evaluation",)

    @property
    def leaves(self) -> tuple[str, ...]:
        """Names of the files of the agent that is trained."""
        return AGENT_FILES if self.trains else ()

    @property
    def trains(self) -> bool:
        """Whether an agent is trained in this run."""
        return self.policy_kind == "trained" and not self.agent_files

    @property
    def name(self) -> str:
        """Name of the run in file names and progress lines."""
        return "-".join(filter(None, (self.grid_point, self.arm, str(self.index)))).replace(" ", "-").replace(":", "-")

    @property
    def training_seed(self) -> int:
        """Seed of the training environments and of the networks; the same in all arms.

        A training that goes on meets other random numbers than it had before.
        """
        return self._seeds(*([self.start.steps] if self.start else []))[0]

    @property
    def evaluation_seed(self) -> int:
        """Seed of the evaluation episodes; the same in all arms."""
        return self._seeds()[1]

    @property
    def key(self) -> str:
        """SHA-256 of all that the result depends on: settings, environment, source, versions of packages."""
        names = set(self.__dataclass_fields__) - {"certificate", "certificate_basis", "grid_point", "module"}
        certificate = self.certificate_basis or self.certificate.checksum
        content = {name: getattr(self, name) for name in names}
        content |= {
            "module": module_digest(self.module),
            "environment": registration_of(self.loop.env),
            "certificate": certificate,
            "training_loop": _described(self.training_loop, certificate),
            "loop": _described(self.loop, certificate),
            "agent_files": _digests(self.agent_files),
            "start": self.start and {"files": _digests(self.start.files), "history": to_json(self.start.history)},
        }
        return digest(content | {"versions": versions()})

    @property
    def total_steps(self) -> int:
        """Training steps, in whole rollouts, and evaluation steps."""
        evaluation = self.episodes * (self.loop.episode_steps or 1) * (1 + len(self.scenarios))
        if not self.trains:
            return evaluation
        rollout = rollout_steps(self.algorithm, self.settings)
        return -(-self.remaining_steps // rollout) * rollout + evaluation

    @property
    def remaining_steps(self) -> int:
        """Training steps that are left, one at least."""
        return max(self.steps - self.start.steps, 1) if self.start else self.steps

    def execute(self, on_progress: Callable[[int], None], log_folder: Path | None = None) -> RunResult:
        """Returns the result; only TensorBoard's events are written."""
        if self.module:
            import_module(self.module)
        trained = None
        if self.trains:
            from agents.training import (
                train,
            )  # imports torch, which the process that only collects results does without

            logs = log_folder and log_folder / self.name
            if logs is not None and self.start is None:
                shutil.rmtree(logs, ignore_errors=True)
            trained = train(
                self.training_loop,
                self.remaining_steps,
                self.training_seed,
                self.algorithm,
                self.settings,
                log_folder=logs,
                checkpoints=logs and logs / CHECKPOINT,
                on_progress=on_progress,
                start=self.start and _loaded(self.start.files),
                history=self.start.history if self.start else (),
            )
        agent = trained.agent if trained else _agent_of(self)
        evaluations = {}
        for scenario in (AS_TRAINED, *self.scenarios):
            loop, policy = under(scenario, self.loop), _policy(self, agent)  # a random policy begins anew each time
            level = self.certificate.polytope or self.certificate.M
            evaluations[scenario] = evaluate(loop, policy, self.episodes, self.evaluation_seed, level, on_progress)
        evaluation = evaluations.pop(AS_TRAINED)
        return RunResult(
            arm=self.arm,
            index=self.index,
            train_steps=trained.steps if trained else 0,
            train_violation_steps=trained.violation_steps if trained else 0,
            train_interventions=trained.interventions if trained else 0,
            history=trained.history if trained else [],
            episodes=evaluation.episodes,
            trajectory=evaluation.trajectory,
            files=trained.agent.files() if trained else {},
            scenarios={scenario: each.episodes for scenario, each in evaluations.items()},
        )

    def require(self, result: RunResult) -> None:
        """Raises unless a result can be this run's.

        Raises:
            ValueError: If it has a value that the run cannot have had; the message names the first.
        """
        for name, value, holds in _judged(self, result):
            if not holds:
                raise ValueError(f"{name} of this run cannot be {shown(value)}")

    def _seeds(self, *more: int) -> list[int]:
        """Returns two 31-bit numbers that depend on the experiment's seed and the run's index, not on the arm."""
        return [int(word >> 1) for word in np.random.SeedSequence([self.seed, self.index, *more]).generate_state(2)]


def _judged(run: TrainingRun, result: RunResult) -> Iterator[tuple[str, object, bool]]:
    """Yields the values of a result by name, and whether they can be those of a run."""
    yield "arm", result.arm, result.arm == run.arm
    yield "index", result.index, result.index == run.index
    steps = result.train_steps
    yield "train_steps", steps, run.steps <= steps <= _LARGEST_COUNT if run.trains else steps == 0
    for name in ("train_violation_steps", "train_interventions"):
        yield name, getattr(result, name), 0 <= getattr(result, name) <= steps
    yield "history", result.history, bool(result.history) == bool(steps)
    for before, after in pairwise([TrainingPoint(0, 0.0, 0, 0), *result.history]):
        counted = after.violation_steps, after.interventions
        falls = after.violation_steps < before.violation_steps or after.interventions < before.interventions
        yield "history", after, before.steps < after.steps <= steps and max(counted) <= after.steps and not falls
    yield "scenarios", result.scenarios, result.scenarios.keys() == set(run.scenarios)
    others = {f"scenarios, {name}": episodes for name, episodes in result.scenarios.items()}
    for name, episodes in {"episodes": result.episodes, **others}.items():
        indices = [each.index for each in episodes]
        yield name, indices, indices == list(range(run.episodes))
        for each in episodes:
            counts = each.violation_steps, each.estimate_violation_steps, each.interventions
            counts += each.planned, each.proved
            counted = 1 <= each.steps <= _LARGEST_COUNT and 0 <= min(counts) <= max(counts) <= each.steps
            numbers = abs(each.episode_return) < LARGEST_NUMBER and 0.0 <= each.largest_level < LARGEST_NUMBER
            yield name, each, counted and numbers
    (m, n), length = run.certificate.K.shape, result.episodes[0].steps
    shapes = {"states": (length + 1, n), "estimates": (length + 1, n), "inputs": (length, m), "proposed": (length, m)}
    for name, array in vars(result.trajectory).items():
        shape, kind = (shapes[name], np.float64) if name in shapes else ((length,), np.bool_)
        yield f"trajectory, {name}", array, array.shape == shape and array.dtype == kind


def _described(loop: LoopConfig, certificate: str) -> dict[str, Any]:
    """Returns a control loop as JSON values, what belongs to the certificate under the name given to that."""
    values = dict(vars(loop))
    for name in ("shield", "filter"):
        values[name] = values[name] and vars(values[name]) | {"certificate": certificate}
    residual = loop.base_policy is not None
    return values | {"lagrangian": loop.lagrangian and asdict(loop.lagrangian), "base_policy": residual}


def _agent_of(run: TrainingRun) -> Agent | None:
    """Returns the agent that a run does not train: that of its files, or one with initial weights; None for none."""
    if run.agent_files:
        return _loaded(run.agent_files)
    if run.policy_kind != "untrained":
        return None
    from agents.training import untrained

    return untrained(run.loop, run.training_seed, run.algorithm, run.settings)


def _loaded(files: dict[str, bytes]) -> Agent:
    from agents.agent import Agent  # imports torch

    with TemporaryDirectory() as folder:
        write_files(Path(folder), files)
        return Agent.load(folder)


def _digests(files: dict[str, bytes]) -> dict[str, str]:
    return {name: hashlib.sha256(file).hexdigest() for name, file in files.items()}


def _policy(run: TrainingRun, agent: Agent | None) -> Policy:
    """Returns what acts in the evaluation of a run: an agent, or for None the run's controller, which begins anew."""
    if agent is not None:
        return lambda observations, infos: agent.act(observations)
    env, fallback, weights = ncs_env(run.loop.single()), run.certificate.fallback, tuned_weights(run.loop.env, run.arm)
    return controller(run.policy_kind, env, fallback, run.evaluation_seed, weights)


def require_trainable(settings: LearningSettings, loop: LoopConfig) -> None:
    """Raises what training would raise later if agents cannot be trained with the hyperparameters given."""
    if settings.hyperparams or settings.conf_file is not None or loop.lagrangian is not None:
        from agents import training  # imports torch

        training.require_trainable(loop, settings.training_steps, settings.algo, settings.all_hyperparams)
