"""Runs the units of an experiment, without those that were finished before."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gymnasium as gym

from agents.settings import OffPolicySettings
from experiments.backends import processes as pool
from experiments.runs.run_store import UnitStore
from experiments.runs.training_run import Unit, UnitResult
from experiments.settings.backend import EngineSettings


def results_of(units: Sequence[Unit], folder: Path, settings: EngineSettings) -> list[UnitResult]:
    """Returns the results of all units, in their order, without files; each is stored as soon as it is there.

    Args:
        units: The experiment.
        folder: Where finished units are, and go.
        settings: Where to run what is missing.

    Raises:
        ResultsError: If a stored result is damaged.
        RunError: If a unit fails.
        ClusterError: If a cluster cannot run them.
        OSError: If the folder cannot be written.
    """
    if len({unit.name for unit in units}) < len(units):
        raise ValueError("two units have the same name")
    store = UnitStore(folder)
    results = {unit.name: _light(result) for unit in units if (result := store.load(unit)) is not None}
    missing = [unit for unit in units if unit.name not in results]
    if results:
        print(f"{len(results)} of {len(units)} units were finished before", file=sys.stderr)

    def keep(unit: Unit, result: UnitResult) -> None:
        store.save(unit, result)
        results[unit.name] = _light(result)

    if missing and settings.engine == "ray":
        from experiments.backends import ray_backend as ray_engine  # an extra

        ray_engine.run_all(missing, _steps, settings, keep)
    elif missing:
        jobs = min(settings.jobs, len(missing))
        pool.run_all(missing, jobs, sum(map(_steps, missing)), keep, folder / "tensorboard")
    return [results[unit.name] for unit in units]


def _light(result: UnitResult) -> UnitResult:
    """Returns a result without its files, which are on disk: those of many units would fill the memory."""
    return replace(result, files={})


def _steps(unit: Unit) -> int:
    """Returns how many training and evaluation steps a unit takes."""
    evaluation = unit.episodes * (gym.spec(unit.env).max_episode_steps or 1)
    if unit.learner != "agent":
        return evaluation
    settings = unit.settings
    rollout = settings.envs * (1 if isinstance(settings, OffPolicySettings) else settings.rollout)
    return -(-unit.steps // rollout) * rollout + evaluation
