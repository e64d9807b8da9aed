"""Executes the training runs of an experiment that were not finished before."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from experiments.backends import worker_processes
from experiments.runs import RunResult, RunStore, TrainingRun
from experiments.settings import BackendSettings

# Period of the progress bar on a terminal and in a file [s].
_TERMINAL_PERIOD, _FILE_PERIOD = 0.5, 20.0


def results_of(runs: Sequence[TrainingRun], folder: Path, settings: BackendSettings) -> list[RunResult]:
    """Returns the results of all runs, in their order, without the agents' files; each is stored when it is finished.

    Args:
        runs: Training runs with different names.
        folder: Output folder with the results of finished runs.
        settings: Where the other runs are executed.

    Raises:
        ResultsError: If a stored result is damaged.
        RunError: If a run fails.
        ClusterError: If a cluster cannot execute the runs.
        OSError: If the folder cannot be written.
    """
    if len({run.name for run in runs}) < len(runs):
        raise ValueError("two training runs have the same name")
    store = RunStore(folder)
    results = {run.name: _without_files(result) for run in runs if (result := store.load(run)) is not None}
    missing = [run for run in runs if run.name not in results]
    if results:
        print(f"{len(results)} of {len(runs)} runs were finished before", file=sys.stderr)
    if not missing:
        return [results[run.name] for run in runs]
    counted = "training and evaluation" if any(run.trains for run in missing) else "evaluation"
    with progress_bar(sum(run.total_steps for run in missing), counted) as bar:

        def keep(run: TrainingRun, result: RunResult) -> None:
            store.save(run, result)
            results[run.name] = _without_files(result)
            bar.write(f"{run.name}: {_described(result)}", file=sys.stderr)

        if settings.engine == "ray":
            from experiments.backends import ray_backend  # needs the extra "ray"

            ray_backend.execute_all(missing, settings, keep, bar.update)
        else:
            jobs = min(settings.jobs, len(missing))
            worker_processes.execute_all(missing, jobs, keep, bar.update, folder / "tensorboard")
    return [results[run.name] for run in runs]


def progress_bar(total_steps: int, counted: str | None = None) -> tqdm:
    """Returns a progress bar of simulated steps on stderr.

    Args:
        total_steps: Number of steps in all.
        counted: What the steps belong to, in front of the bar; None if there is only one thing.
    """
    period = _TERMINAL_PERIOD if sys.stderr.isatty() else _FILE_PERIOD
    return tqdm(
        total=total_steps,
        desc=counted,
        unit="step",
        unit_scale=True,
        mininterval=period,
        miniters=0,
        file=sys.stderr,
    )


def _described(result: RunResult) -> str:
    """Returns the outcome of a run in one line."""
    violating = sum(episode.violation_steps > 0 for episode in result.episodes)
    mean = sum(episode.episode_return for episode in result.episodes) / len(result.episodes)
    training = f"{result.train_violation_steps:,} violating training steps, " if result.train_steps else ""
    return f"{training}{violating} of {len(result.episodes)} episodes violating, return {mean:z.2f}"


def _without_files(result: RunResult) -> RunResult:
    """Returns a result without the agent's files, which are on disk: those of many runs would fill the memory."""
    return replace(result, files={})
