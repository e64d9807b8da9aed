"""Executes jobs in worker processes of this machine."""

from __future__ import annotations

import multiprocessing
import queue
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from multiprocessing.managers import SyncManager
from typing import Any

from experiments.backends.job import Job, OnResult
from experiments.backends.worker_init import initialize_worker
from experiments.errors import RunError, RunStopped
from experiments.warning_sentences import warnings_sent

# Smallest number of steps that a worker reports at a time.
_REPORTED_STEPS = 1000
# How often the reports are read [s].
_READING_PERIOD = 0.5


def execute_all(jobs: Sequence[Job], workers: int, on_result: OnResult, on_progress: Callable[[int], object]) -> None:
    """Executes all jobs; the first failure stops the others and is raised.

    Args:
        jobs: The jobs, which begin in this order.
        workers: Largest number of worker processes.
        on_result: Called with every job and its result when it is finished.
        on_progress: Called with the number of steps taken since its last call.

    Raises:
        RunError: If a job fails.
    """
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    manager.start(initialize_worker)
    workers = min(workers, len(jobs))
    with manager, ProcessPoolExecutor(workers, mp_context=context, initializer=initialize_worker) as executor:
        reports, stop = manager.Queue(), manager.Event()
        futures = {executor.submit(_execute, job, reports, stop): job for job in jobs}
        try:
            _collect(futures, reports, on_result, on_progress)
        except BaseException:
            stop.set()
            executor.shutdown(cancel_futures=True)
            raise


def _execute(job: Job, reports: Any, stop: Any) -> Any:
    """Executes a job in a worker process; it gives up at its next report after `stop` is set.

    Reports are numbers of steps, and the texts of warnings.
    """
    unreported = 0

    def report(steps: int) -> None:
        nonlocal unreported
        unreported += steps
        if unreported >= _REPORTED_STEPS:
            if stop.is_set():
                raise RunStopped(f"{job.name} gave up: another run failed, or the user interrupted")
            reports.put(unreported)
            unreported = 0

    with warnings_sent(reports.put):
        result = job.work(report)
    reports.put(unreported)
    return result


def _collect(
    futures: dict[Future, Job], reports: Any, on_result: OnResult, on_progress: Callable[[int], object]
) -> None:
    """Passes reports, warnings and results on until every job is finished; raises the first failure."""
    pending = set(futures)
    while pending:
        done, pending = wait(pending, timeout=_READING_PERIOD, return_when=FIRST_COMPLETED)
        while True:
            try:
                report = reports.get_nowait()
            except queue.Empty:
                break
            if isinstance(report, str):
                warnings.warn(report, stacklevel=1)
            else:
                on_progress(report)
        for future in sorted(done, key=lambda each: each.exception() is not None):
            on_result(futures[future], _result(futures[future], future))


def _result(job: Job, future: Future) -> Any:
    """Returns the result of a finished job.

    Raises:
        RunError: If the job failed.
    """
    try:
        return future.result()
    except (BrokenExecutor, RunStopped):
        raise  # not this job's own failure
    except Exception as error:
        raise RunError.of(job.name, error) from error
