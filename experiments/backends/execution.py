"""Executes runs side by side, with a progress bar and a stop, and keeps their results."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from agents.agent import AGENT_FILES
from experiments.runs.training_run import RunResult, TrainingRun
from experiments.settings import BackendSettings
from experiments.terminal import progress_bar, say, sentence_of
from shields.documents import write_atomically

# How often the bar moves [s].
_PERIOD = 0.5
# What executes a run of some number elsewhere: its future result is that of `executed`. Beside it stands the error of a
# future whose worker died.
Engine = tuple[Callable[[int, TrainingRun], Future[tuple[RunResult, list[str]]]], type[Exception]]


class RunError(RuntimeError):
    """A run failed, was stopped, or lost its worker; or the cluster cannot execute it."""


def results_of(runs: Sequence[TrainingRun], folder: Path, settings: BackendSettings) -> list[RunResult]:
    """Returns the results of runs of different names, in their order; each is stored when it is finished.

    Those whose results are in the folder already are not executed again.

    Raises:
        RunError: If a run fails, which stops the others, workers died, which costs their own runs only, or a cluster
            cannot execute the runs.
        OSError: If the folder cannot be written.
    """
    if len(set(map(file_name, runs))) < len(runs):
        raise ValueError("two runs have the same name")
    results = {run.name: result for run in runs if (result := load(folder, run)) is not None}
    missing = [run for run in runs if run.name not in results]
    if results:
        say(f"{len(results)} of {len(runs)} runs were finished before")

    def keep(run: TrainingRun, result: RunResult) -> None:
        save(folder, run, result)
        results[run.name] = result
        say(f"{run.name}: {result.outcome}")

    if missing:
        counts = multiprocessing.get_context("spawn").RawArray("q", len(missing) + 1)
        if settings.engine == "ray":
            from experiments.backends.ray_tasks import ray_tasks  # needs the extra "ray"

            where = ray_tasks(settings.ray_address)
        else:
            where = local_workers(min(settings.jobs, len(missing)), counts, folder / "tensorboard")
        execute(missing, counts, where, keep)
    return [results[run.name] for run in runs]


def file_name(run: TrainingRun) -> str:
    """Returns the name of a run's file: its name, with hyphens for what is special in file names."""
    return re.sub(r"[^\w.+-]+", "-", run.name) + ".json"


def save(folder: Path, run: TrainingRun, result: RunResult) -> None:
    """Writes the result of a run into `runs/NAME.json`, and before it the agent's files into `models/NAME/`."""
    path, models = folder / "runs" / file_name(run), folder / "models" / run.name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)  # an older result must not stand for the newer agent
    for name, content in result.files.items():
        models.mkdir(parents=True, exist_ok=True)
        write_atomically(models / name, content)
    values = {name: value for name, value in asdict(result).items() if name != "files"}
    write_atomically(path, json.dumps({"key": run.key, "result": values}) + "\n")


def load(folder: Path, run: TrainingRun) -> RunResult | None:
    """Returns the result of a run; None if there is none of its settings and versions, or not whole."""
    path, models = folder / "runs" / file_name(run), folder / "models" / run.name
    files = [models / name for name in AGENT_FILES] if run.trains else []
    if not path.exists() or not all(file.is_file() for file in files):
        return None
    try:
        document = json.loads(path.read_bytes())
        if document["key"] != run.key:
            return None
        content = {file.name: file.read_bytes() for file in files}
        return replace(RunResult.of_json(document["result"]), files=content)
    except (OSError, LookupError, TypeError, ValueError, RecursionError):
        say(f"{path} is damaged: its run is done again")
        return None


def execute(
    runs: Sequence[TrainingRun],
    counts: Any,
    where: AbstractContextManager[Engine],
    keep: Callable[[TrainingRun, RunResult], object],
) -> None:
    """Executes runs and hands each result to `keep` when it is there; for errors see `results_of`.

    Args:
        runs: The runs.
        counts: Steps that each run has taken; one entry more.
        where: What executes them, and stops them where it is left by an exception.
        keep: Takes a run and its result.
    """
    lost = []
    what = "training and evaluation" if any(run.trains for run in runs) else "evaluation"
    with progress_bar(sum(run.total_steps for run in runs), what) as bar, where as (submit, worker_died):
        numbers = {submit(number, run): number for number, run in enumerate(runs)}
        while numbers:
            finished, _ = wait(numbers, _PERIOD, FIRST_COMPLETED)
            for future in sorted(finished, key=lambda each: each.exception() is not None):
                number, error = numbers.pop(future), future.exception()
                run, counts[number] = runs[number], runs[number].total_steps
                if error is None:
                    result, texts = future.result()
                    for text in texts:
                        warnings.warn(text, stacklevel=1)
                    keep(run, result)
                    continue
                cause = getattr(error, "cause", None) or error  # Ray's errors of tasks have what a task raised
                if isinstance(cause, worker_died):
                    lost.append(run.name)
                else:
                    known = isinstance(cause, RunError)
                    raise cause if known else RunError(f"run {run.name}: {sentence_of(cause)}") from error
            bar.update(sum(counts[:-1]) - bar.n)
    if lost:
        raise RunError(f"worker processes died in {', '.join(lost)}: the same command goes on with what is missing")


def executed(
    run: TrainingRun, report: Callable[[int], None], log_folder: Path | None = None
) -> tuple[RunResult, list[str]]:
    """Returns the result of a run, and the texts of its warnings; for arguments see `TrainingRun.execute`."""
    with warnings.catch_warnings(record=True) as caught:
        result = run.execute(report, log_folder)
    return result, [str(each.message) for each in caught]


@contextmanager
def local_workers(jobs: int, counts: Any, log_folder: Path | None = None) -> Iterator[Engine]:
    """Yields worker processes of this machine, each a pool of its own: one that dies breaks no other.

    They count the steps of each run in `counts`, shared memory whose last entry tells them to stop.
    """
    context, pools, own = multiprocessing.get_context("spawn"), list[ProcessPoolExecutor](), threading.local()

    def in_pool(number: int, run: TrainingRun) -> tuple[RunResult, list[str]]:
        if not hasattr(own, "pool"):
            own.pool = ProcessPoolExecutor(1, context, _begin_worker, (counts,))
            pools.append(own.pool)
        try:
            return own.pool.submit(_work, number, run, log_folder).result()
        except BrokenProcessPool:
            del own.pool
            raise

    threads = ThreadPoolExecutor(jobs)
    try:
        yield partial(threads.submit, in_pool), BrokenProcessPool
    except BaseException:
        counts[-1] = 1
        say("stopping what runs")
        raise
    finally:
        threads.shutdown(cancel_futures=True)
        for pool in pools:
            pool.shutdown()


# What `local_workers` gave this worker process.
_counts: Any = None


def _begin_worker(counts: Any) -> None:
    """Leaves Ctrl-C to the parent, and ends this process when its parent ends, however that happens."""
    global _counts
    _counts = counts
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
    os._exit(1)


def _work(number: int, run: TrainingRun, log_folder: Path | None) -> tuple[RunResult, list[str]]:
    def report(steps: int) -> None:
        _counts[number] += steps
        if _counts[-1]:
            raise RunError(f"{run.name} gave up: another run failed, or the user interrupted")

    return executed(run, report, log_folder)
