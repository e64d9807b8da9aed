"""Executes runs in worker processes of this machine."""

from __future__ import annotations

import multiprocessing
import queue
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing.managers import SyncManager
from pathlib import Path
from typing import Any

from experiments.backends.worker_init import initialize_worker
from experiments.errors import RunError, RunStopped
from experiments.runs.run import Run
from experiments.warning_sentences import warnings_sent

# Smallest number of steps that a worker reports at a time.
_REPORTED_STEPS = 1000


@contextmanager
def local_workers(workers: int, log_folder: Path | None = None) -> Iterator[LocalWorkers]:
    """Yields worker processes, an `execution.Executor`.

    Args:
        workers: Largest number of worker processes.
        log_folder: Folder of TensorBoard's events; None for none.
    """
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    manager.start(initialize_worker)
    with manager, ProcessPoolExecutor(workers, mp_context=context, initializer=initialize_worker) as pool:
        reports, stop = manager.Queue(), manager.Event()
        try:
            yield LocalWorkers(pool, reports, stop, log_folder)
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise


class LocalWorkers:
    """Worker processes, the queue that they report to, and the event that tells them to give up."""

    def __init__(self, pool: ProcessPoolExecutor, reports: Any, stop: Any, log_folder: Path | None) -> None:
        self._pool, self._reports, self._stop, self._log_folder = pool, reports, stop, log_folder

    def submit(self, run: Run) -> Future[Any]:
        """Returns the future result of a run."""
        return self._pool.submit(_execute, run, self._reports, self._stop, self._log_folder)

    def reports(self) -> Iterator[int | str]:
        """Yields numbers of steps taken, and the texts of warnings."""
        with suppress(queue.Empty):
            while True:
                yield self._reports.get_nowait()

    def failure(self, run: Run, error: BaseException) -> BaseException:
        """Returns the error of the run, unless it is not its own."""
        return error if isinstance(error, BrokenExecutor | RunStopped) else RunError.of(run.name, error)


def _execute(run: Run, reports: Any, stop: Any, log_folder: Path | None) -> Any:
    """Executes a run in a worker process; it gives up at its next report after `stop` is set."""
    unreported = 0

    def report(steps: int) -> None:
        nonlocal unreported
        unreported += steps
        if unreported >= _REPORTED_STEPS:
            if stop.is_set():
                raise RunStopped(f"{run.name} gave up: another run failed, or the user interrupted")
            reports.put(unreported)
            unreported = 0

    with warnings_sent(reports.put):
        result = run.execute(report, log_folder)
    reports.put(unreported)
    return result
