"""Executes runs side by side, with a progress bar and a stop, and keeps their results."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from experiments.errors import ClusterError, RunError, RunStopped
from experiments.runs.output_folder import file_name, load, save
from experiments.settings import BackendSettings
from experiments.terminal import progress_bar, say, warnings_sent

# How often the bar moves [s].
_PERIOD = 0.5
# What executes a run of some number elsewhere: its future result is that of `executed`. Beside it stands the error of a
# future whose worker died.
Engine = tuple[Callable[[int, Any], Future[tuple[Any, list[str]]]], type[Exception]]


def results_of(runs: Sequence[Any], folder: Path, settings: BackendSettings) -> list[Any]:
    """Returns the results of all runs, in their order; each is stored when it is finished.

    Args:
        runs: `TrainingRun`s of different names. Those whose results are in the folder are not executed again.
        folder: Output folder.
        settings: Where they are executed.

    Raises:
        RunError: If a run fails, which stops the others, or workers died, which costs their own runs only.
        ClusterError: If a cluster cannot execute the runs.
        OSError: If the folder cannot be written.
    """
    if len(set(map(file_name, runs))) < len(runs):
        raise ValueError("two runs have the same name")
    results = {run.name: result for run in runs if (result := load(folder, run)) is not None}
    missing = [run for run in runs if run.name not in results]
    if results:
        say(f"{len(results)} of {len(runs)} runs were finished before")

    def keep(run: Any, result: Any) -> None:
        save(folder, run, result)
        results[run.name] = result
        if result.outcome:
            say(f"{run.name}: {result.outcome}")

    if missing:
        counts = multiprocessing.get_context("spawn").RawArray("q", len(missing) + 1)
        execute(missing, counts, _engine(settings, len(missing), counts, folder / "tensorboard"), keep)
    return [results[run.name] for run in runs]


def _engine(settings: BackendSettings, runs: int, counts: Any, log_folder: Path) -> AbstractContextManager[Engine]:
    """Returns where runs are executed; TensorBoard's events are left by workers of this machine alone."""
    if settings.engine == "ray":
        from experiments.backends.ray_tasks import ray_tasks  # needs the extra "ray"

        return ray_tasks(settings.ray_address)
    return local_workers(min(settings.jobs, runs), counts, log_folder)


def execute(
    runs: Sequence[Any], counts: Any, where: AbstractContextManager[Engine], keep: Callable[[Any, Any], object]
) -> None:
    """Executes runs, and hands each result on when it is there; for errors see `results_of`.

    Args:
        runs: The runs.
        counts: Steps that each run has taken; one entry more.
        where: What executes them, and stops them where it is left by an exception.
        keep: Takes a run and its result.
    """
    lost = []
    with _bar(runs) as bar, where as (submit, worker_died):
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
                    known = isinstance(cause, ClusterError | RunStopped)
                    raise cause if known else RunError.of(run.name, cause) from error
            bar.update(sum(counts[:-1]) - bar.n)
    if lost:
        raise RunError(f"worker processes died in {', '.join(lost)}: the same command goes on with what is missing")


def _bar(runs: Sequence[Any]) -> tqdm:
    parts = " and ".join(sorted({part for run in runs for part in run.parts}, reverse=True))
    return progress_bar(sum(run.total_steps for run in runs), parts, " and ".join({run.unit for run in runs}))


def executed(run: Any, report: Callable[[int], None], log_folder: Path | None = None) -> tuple[Any, list[str]]:
    """Returns the result of a run, and the texts of its warnings.

    Args:
        run: The run.
        report: Called with numbers of steps taken.
        log_folder: Folder in which it leaves TensorBoard's events; None for none.
    """
    texts: list[str] = []
    with warnings_sent(texts.append):
        return run.execute(report, log_folder), texts


@contextmanager
def local_workers(jobs: int, counts: Any, log_folder: Path | None = None) -> Iterator[Engine]:
    """Yields worker processes of this machine, each a pool of its own: one that dies breaks no other.

    Args:
        jobs: How many there are.
        counts: Shared memory in which they count the steps of each run; its last entry tells them to stop.
        log_folder: As for `executed`.
    """
    context, pools, own = multiprocessing.get_context("spawn"), list[ProcessPoolExecutor](), threading.local()

    def in_pool(number: int, run: Any) -> tuple[Any, list[str]]:
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


def _work(number: int, run: Any, log_folder: Path | None) -> tuple[Any, list[str]]:
    def report(steps: int) -> None:
        _counts[number] += steps
        if _counts[-1]:
            raise RunStopped(f"{run.name} gave up: another run failed, or the user interrupted")

    return executed(run, report, log_folder)
