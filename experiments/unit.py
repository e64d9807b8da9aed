"""The unit of work: one policy trained and evaluated; a function of its settings alone."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np

from agents.callbacks import TrainingPoint
from agents.evaluation import Episode, Policy, evaluate
from agents.settings import PPOSettings
from agents.training import Shielding, TrainingResult, train, untrained
from experiments.trajectory import Trajectory, record
from shields import Certificate

Learner = Literal["ppo", "untrained", "gain", "zero"]


@dataclass(frozen=True, kw_only=True)
class Unit:
    """Settings of one unit.

    Attributes:
        arm: Name of the arm it belongs to.
        learner: "ppo" is trained; "untrained" has its initial weights, "gain" is u = K x_hat, "zero" does nothing.
        env: A registered id.
        seed: Of the experiment.
        index: Number of the run within its arm; runs with equal index are paired across arms.
        steps: Training steps.
        episodes: Evaluation episodes.
        certificate: For the shield and for x'Mx.
        mode: The shield's; None for no shield.
        penalty: The shield's.
        ppo: Settings of PPO.
        folder: Where the model and TensorBoard's events go.
    """

    arm: str
    learner: Learner
    env: str
    seed: int
    index: int
    steps: int
    episodes: int
    certificate: Certificate
    mode: str | None
    penalty: float
    ppo: PPOSettings
    folder: Path

    @property
    def name(self) -> str:
        """For files and progress lines."""
        return f"{self.arm}-{self.index}".replace(" ", "-")

    @property
    def shielding(self) -> Shielding | None:
        """The shield's settings, None without one."""
        return None if self.mode is None else Shielding(self.certificate, self.mode, self.penalty)

    @property
    def training_seed(self) -> int:
        """Seed of the first training environment (the others take the next ones) and of the network."""
        return self._seeds()[0]

    @property
    def evaluation_seed(self) -> int:
        """Seed of the first evaluation episode; alike in all arms, as is the training seed."""
        return self._seeds()[1]

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
        history: Totals after each rollout.
        episodes: Evaluation.
        trajectory: The first evaluation episode.
    """

    arm: str
    index: int
    train_steps: int
    train_violation_steps: int
    train_interventions: int
    history: list[TrainingPoint]
    episodes: list[Episode]
    trajectory: Trajectory


def run_unit(unit: Unit, on_progress: Callable[[int], None]) -> UnitResult:
    """Returns the result of a unit; saves a trained model under its folder.

    Args:
        unit: The settings.
        on_progress: Called with the number of training steps or finished evaluation steps since its last call.
    """
    trained = _train(unit, on_progress) if unit.learner == "ppo" else None
    policy = _policy(unit, trained)
    level_matrix = unit.certificate.M
    length = gym.spec(unit.env).max_episode_steps or 1
    episodes = evaluate(
        unit.env,
        policy,
        unit.episodes,
        unit.evaluation_seed,
        unit.shielding,
        level_matrix,
        lambda finished: on_progress(finished * length),
    )
    return UnitResult(
        arm=unit.arm,
        index=unit.index,
        train_steps=trained.steps if trained else 0,
        train_violation_steps=trained.violation_steps if trained else 0,
        train_interventions=trained.interventions if trained else 0,
        history=trained.history if trained else [],
        episodes=episodes,
        trajectory=record(unit.env, policy, unit.evaluation_seed, unit.shielding),
    )


def _train(unit: Unit, on_progress: Callable[[int], None]) -> TrainingResult:
    """Trains, and moves the finished model into place in one step."""
    events = unit.folder / "tensorboard" / unit.name
    shutil.rmtree(events, ignore_errors=True)
    result = train(
        unit.env,
        unit.steps,
        unit.training_seed,
        unit.shielding,
        unit.ppo,
        log_folder=events,
        on_progress=on_progress,
    )
    partial, place = unit.folder / f".{unit.name}.partial", unit.folder / "models" / unit.name
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    result.agent.save(partial)
    shutil.rmtree(place, ignore_errors=True)
    place.parent.mkdir(exist_ok=True)
    os.replace(partial, place)
    return result


def _policy(unit: Unit, trained: TrainingResult | None) -> Policy:
    """Returns the policy to evaluate."""
    if trained is not None:
        return lambda observations, infos: trained.agent.act(observations)
    plant = gym.make(unit.env).unwrapped.plant
    if unit.learner == "untrained":
        agent = untrained(unit.env, unit.training_seed, unit.ppo)
        return lambda observations, infos: agent.act(observations)
    if unit.learner == "gain":
        gain = unit.certificate.K / plant.u_max[:, None]
        return lambda observations, infos: np.clip([gain @ info["estimate"] for info in infos], -1.0, 1.0)
    return lambda observations, infos: np.zeros((len(infos), plant.m), np.float32)
