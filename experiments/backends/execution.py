"""Executes the jobs of an experiment, and keeps its results so that it goes on where it was interrupted."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from tqdm import tqdm

from experiments.backends import worker_processes
from experiments.backends.job import Job, OnResult
from experiments.runs import RunResult, RunStore, TrainingRun, execute_run
from experiments.settings import BackendSettings

# Period of the progress bar on a terminal and in a file [s].
_TERMINAL_PERIOD, _FILE_PERIOD = 0.5, 20.0


def execute(jobs: Sequence[Job], settings: BackendSettings, on_result: OnResult, *, counted: str | None = None) -> None:
    """Executes jobs, with a progress bar on stderr; the first failure stops the others and is raised.

    Args:
        jobs: Jobs with different names.
        settings: Where they are executed.
        on_result: Called here with each job and its result when it is finished.
        counted: What the steps belong to, in front of the bar; None if there is only one thing.

    Raises:
        RunError: If a job fails.
        ClusterError: If a cluster cannot execute the jobs.
    """
    period = _TERMINAL_PERIOD if sys.stderr.isatty() else _FILE_PERIOD
    with tqdm(
        total=sum(job.steps for job in jobs),
        desc=counted,
        unit="step",
        unit_scale=True,
        mininterval=period,
        miniters=0,
        file=sys.stderr,
    ) as bar:
        if settings.engine == "ray":
            from experiments.backends import ray_backend  # needs the extra "ray"

            ray_backend.execute_all(jobs, settings, on_result, bar.update)
        else:
            worker_processes.execute_all(jobs, settings.jobs, on_result, bar.update)


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
    by_name = {run.name: run for run in runs}
    if len(by_name) < len(runs):
        raise ValueError("two training runs have the same name")
    store = RunStore(folder)
    results = {run.name: _without_files(result) for run in runs if (result := store.load(run)) is not None}
    missing = [run for run in runs if run.name not in results]
    if results:
        print(f"{len(results)} of {len(runs)} runs were finished before", file=sys.stderr)

    def keep(job: Job, result: RunResult) -> None:
        store.save(by_name[job.name], result)
        results[job.name] = _without_files(result)
        tqdm.write(f"{job.name}: {_described(result)}", file=sys.stderr)

    if missing:
        logs = folder / "tensorboard" if settings.engine == "local" else None  # nodes do not write into the folder
        jobs = [_job(run, logs and logs / run.name) for run in missing]
        counted = "training and evaluation" if any(run.trains for run in missing) else "evaluation"
        execute(jobs, settings, keep, counted=counted)
    return [results[run.name] for run in runs]


def _job(run: TrainingRun, log_folder: Path | None) -> Job:
    return Job(run.name, run.total_steps, partial(execute_run, run, log_folder=log_folder))


def _described(result: RunResult) -> str:
    """Returns the outcome of a run in one line."""
    violating = sum(episode.violation_steps > 0 for episode in result.episodes)
    mean = sum(episode.episode_return for episode in result.episodes) / len(result.episodes)
    training = f"{result.train_violation_steps:,} violating training steps, " if result.train_steps else ""
    return f"{training}{violating} of {len(result.episodes)} episodes violating, return {mean:z.2f}"


def _without_files(result: RunResult) -> RunResult:
    """Returns a result without the agent's files, which are on disk: those of many runs would fill the memory."""
    return replace(result, files={})
