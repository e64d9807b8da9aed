"""Executes runs in worker processes of this machine or elsewhere, and keeps their results, from which it goes on."""

from __future__ import annotations

import multiprocessing
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from itertools import islice
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from queue import Empty, Queue, SimpleQueue
from typing import Any, Protocol

from tqdm import tqdm

from experiments.backends.worker import Outcome, signals_blocked, work
from experiments.errors import RunError, RunStopped
from experiments.runs.run_store import Run, RunStore, file_name
from experiments.settings import BackendSettings
from experiments.terminal import progress_bar, say

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
    if len(set(map(file_name, runs))) < len(runs):
        raise ValueError("two runs have the same name")
    store = RunStore(folder)
    results = {run.name: _without_files(result) for run in runs if (result := store.load(run)) is not None}
    missing = [run for run in runs if run.name not in results]
    if results:
        say(f"{len(results)} of {len(runs)} runs were finished before")

    def keep(run: Run, result: Any) -> None:
        store.save(run, result)
        results[run.name] = _without_files(result)
        if result.outcome:
            say(f"{run.name}: {result.outcome}")

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
    parts = " and ".join(sorted({part for run in runs for part in run.parts}, reverse=True))
    return progress_bar(sum(run.total_steps for run in runs), parts, " and ".join({run.unit for run in runs}))


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


@contextmanager
def local_workers(workers: int, log_folder: Path | None = None) -> Iterator[LocalWorkers]:
    """Yields worker processes, an `Executor`."""
    pool = LocalWorkers(log_folder)
    try:
        pool.start(workers)
        yield pool
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            say("stopping what runs; Ctrl-C again ends it at once")
        pool.stop()
        raise
    finally:
        pool.kill()


class LocalWorkers:
    """Worker processes, each with a thread here that hands it runs, one after the other, and takes what it sends.

    Processes and threads are daemons: no end of this process waits for one.

    Args:
        log_folder: Folder in which runs leave TensorBoard's events; None for none.
    """

    def __init__(self, log_folder: Path | None) -> None:
        self._log_folder = log_folder
        self._submitted: SimpleQueue[tuple[Run, Future[Any]]] = SimpleQueue()
        self._reports: SimpleQueue[int | str] = SimpleQueue()
        self._processes: list[BaseProcess] = []

    def start(self, workers: int) -> None:
        """Starts worker processes."""
        context = multiprocessing.get_context("spawn")
        told, self._not_told = context.Pipe(duplex=False)  # closed at this end, it tells all of them to stop
        with told:
            for _ in range(workers):
                here, there = context.Pipe()
                process = context.Process(target=work, args=(there, told, self._log_folder), daemon=True)
                with there, signals_blocked():
                    process.start()
                    self._processes.append(process)
                threading.Thread(target=self._serve, args=(here,), daemon=True).start()

    def submit(self, run: Run) -> Future[Any]:
        """Returns the future result of a run."""
        future: Future[Any] = Future()
        self._submitted.put((run, future))
        return future

    def reports(self) -> Iterator[int | str]:
        """Yields what came since the last call."""
        with suppress(Empty):
            while True:
                yield self._reports.get_nowait()

    def failure(self, run: Run, error: BaseException) -> BaseException:
        """Returns the error of a run, with its name."""
        return error if isinstance(error, RunError | RunStopped) else RunError.of(run.name, error)

    def stop(self) -> None:
        """Returns when all that is executed has given up, which it does at its next report, or has ended."""
        if self._processes:
            self._not_told.close()
        for process in self._processes:
            process.join()

    def kill(self) -> None:
        """Ends all processes at once."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.join()

    def _serve(self, worker: Connection) -> None:
        while True:
            run, future = self._submitted.get()
            try:
                worker.send(run)
                while not isinstance(sent := worker.recv(), Outcome):
                    self._reports.put(sent)
            except (EOFError, OSError):
                future.set_exception(RunError(f"run {run.name}: its worker process ended by itself"))
                return
            except Exception as error:  # what cannot be sent, or read
                future.set_exception(error)
            else:
                if sent.error is None:
                    future.set_result(sent.result)
                else:
                    future.set_exception(sent.error)
