"""Executes runs in worker processes of this machine or elsewhere, and keeps their results, from which it goes on."""

from __future__ import annotations

import multiprocessing
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from itertools import islice
from multiprocessing.managers import SyncManager
from pathlib import Path
from queue import Empty, Queue
from typing import Any, Protocol

from tqdm import tqdm

from experiments.backends.worker_init import initialize_worker
from experiments.errors import RunError, RunStopped
from experiments.runs.run_store import Run, RunStore
from experiments.settings import BackendSettings
from experiments.terminal import warnings_sent

# Period of the progress bar on a terminal and in a file [s].
_TERMINAL_PERIOD, _FILE_PERIOD = 0.5, 20.0
# How often the reports of runs are read [s].
_READING_PERIOD = 0.5
# Largest number of runs that are submitted and not finished: more than a cluster executes at once, so that no core
# waits for the driver and a cluster that grows on demand sees that there is more to do.
MAX_SUBMITTED = 10_000


class Executor(Protocol):
    """Executes runs elsewhere, as a context that stops what it executes when it is left by an exception."""

    def submit(self, run: Run) -> Future[Any]:
        """Returns the future result of a run."""
        ...

    def reports(self) -> Iterable[int | str]:
        """Returns what came since the last call: numbers of steps taken, and the texts of warnings."""
        ...

    def failure(self, run: Run, error: BaseException) -> BaseException:
        """Returns what to raise where a run ended with an error."""
        ...


def results_of(runs: Sequence[Run], folder: Path, settings: BackendSettings) -> list[Any]:
    """Returns the results of all runs, in their order, without the agents' files; each is stored when it is finished.

    Raises:
        ResultsError: If a stored result is damaged.
        RunError: If a run fails.
        ClusterError: If a cluster cannot execute the runs.
        OSError: If the folder cannot be written.
    """
    if len({run.name for run in runs}) < len(runs):
        raise ValueError("two runs have the same name")
    store = RunStore(folder)
    results = {run.name: _without_files(result) for run in runs if (result := store.load(run)) is not None}
    missing = [run for run in runs if run.name not in results]
    if results:
        print(f"{len(results)} of {len(runs)} runs were finished before", file=sys.stderr)

    def keep(run: Run, result: Any) -> None:
        store.save(run, result)
        results[run.name] = _without_files(result)
        if result.outcome:
            tqdm.write(f"{run.name}: {result.outcome}", file=sys.stderr)

    if missing:
        execute(missing, executor_of(settings, len(missing), folder / "tensorboard"), keep)
    return [results[run.name] for run in runs]


def executor_of(settings: BackendSettings, runs: int, log_folder: Path) -> AbstractContextManager[Executor]:
    """Returns where so many runs are executed; TensorBoard's events are left by workers of this machine alone."""
    if settings.engine == "ray":
        from experiments.backends.ray_backend import joined_cluster  # needs the extra "ray"

        return joined_cluster(settings)
    return local_workers(min(settings.jobs, runs), log_folder)


def execute(
    runs: Sequence[Run], where: AbstractContextManager[Executor], on_result: Callable[[Any, Any], object]
) -> None:
    """Executes runs, with a progress bar on stderr.

    Raises:
        RunError: If a run fails: the first failure stops the others, and what finished beside it is kept.
        ClusterError: If a cluster cannot execute the runs.
    """
    waiting, submitted = iter(runs), {}
    done: Queue[Future[Any]] = Queue()
    with _progress_bar(runs) as bar, where as executor:
        while True:
            for run in islice(waiting, MAX_SUBMITTED - len(submitted)):
                submitted[future := executor.submit(run)] = run
                future.add_done_callback(done.put)
            if not submitted:
                return
            finished = _taken(done, _READING_PERIOD)
            for report in executor.reports():
                if isinstance(report, str):
                    warnings.warn(report, stacklevel=1)
                else:
                    bar.update(report)
            for future in sorted(finished, key=lambda each: each.exception() is not None):
                run, error = submitted.pop(future), future.exception()
                if error is not None:
                    raise executor.failure(run, error) from error
                on_result(run, future.result())


def _progress_bar(runs: Sequence[Run]) -> tqdm:
    return tqdm(
        total=sum(run.total_steps for run in runs),
        desc=" and ".join(dict.fromkeys(part for run in runs for part in run.parts)),
        unit="step",
        unit_scale=True,
        mininterval=_TERMINAL_PERIOD if sys.stderr.isatty() else _FILE_PERIOD,
        miniters=0,
        file=sys.stderr,
    )


def _taken(queue: Queue[Future[Any]], timeout: float) -> list[Future[Any]]:
    """Returns what a queue holds, after waiting for the first of it."""
    taken = []
    try:
        taken.append(queue.get(timeout=timeout))
        while True:
            taken.append(queue.get_nowait())
    except Empty:
        return taken


def _without_files(result: Any) -> Any:
    """Returns a result without the agent's files, which are on disk: those of many runs would fill the memory."""
    return replace(result, files={}) if result.files else result


# Smallest number of steps that a worker reports at a time.
_REPORTED_STEPS = 1000


@contextmanager
def local_workers(workers: int, log_folder: Path | None = None) -> Iterator[_LocalWorkers]:
    """Yields worker processes, an `Executor`."""
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    manager.start(initialize_worker)
    with manager, ProcessPoolExecutor(workers, mp_context=context, initializer=initialize_worker) as pool:
        reports, stop = manager.Queue(), manager.Event()
        try:
            yield _LocalWorkers(pool, reports, stop, log_folder)
        except BaseException as error:
            stop.set()
            if isinstance(error, KeyboardInterrupt):
                print("stopping what runs; Ctrl-C again ends it at once", file=sys.stderr, flush=True)
            pool.shutdown(cancel_futures=True)
            raise


class _LocalWorkers:
    """Worker processes, the queue that they report to, and the event that tells them to give up."""

    def __init__(self, pool: ProcessPoolExecutor, reports: Any, stop: Any, log_folder: Path | None) -> None:
        self._pool, self._reports, self._stop, self._log_folder = pool, reports, stop, log_folder

    def submit(self, run: Run) -> Future[Any]:
        return self._pool.submit(_execute_here, run, self._reports, self._stop, self._log_folder)

    def reports(self) -> Iterator[int | str]:
        with suppress(Empty):
            while True:
                yield self._reports.get_nowait()

    def failure(self, run: Run, error: BaseException) -> BaseException:
        return error if isinstance(error, BrokenExecutor | RunStopped) else RunError.of(run.name, error)


def _execute_here(run: Run, reports: Any, stop: Any, log_folder: Path | None) -> Any:
    """Executes a run in a worker process; it gives up at its next report (of 0 steps, say) after `stop` is set."""
    unreported = 0

    def report(steps: int) -> None:
        nonlocal unreported
        unreported += steps
        if unreported >= _REPORTED_STEPS or not steps:
            if stop.is_set():
                raise RunStopped(f"{run.name} gave up: another run failed, or the user interrupted")
            reports.put(unreported)
            unreported = 0

    with warnings_sent(reports.put):
        result = run.execute(report, log_folder)
    reports.put(unreported)
    return result
