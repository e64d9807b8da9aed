"""Executes training runs in worker processes of this machine."""

from __future__ import annotations

import multiprocessing
import queue
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from multiprocessing.managers import SyncManager
from pathlib import Path
from typing import Any

from experiments.backends.worker_init import initialize_worker
from experiments.errors import RunError, RunStopped
from experiments.runs import RunResult, TrainingRun, execute_run
from experiments.warning_sentences import warnings_sent

# Smallest number of steps that a worker reports at a time.
_REPORTED_STEPS = 1000
# How often the reports are read [s].
_READING_PERIOD = 0.5


def execute_all(
    runs: Sequence[TrainingRun],
    jobs: int,
    on_result: Callable[[TrainingRun, RunResult], None],
    on_progress: Callable[[int], object],
    log_folder: Path | None = None,
) -> None:
    """Executes all runs; the first failure stops the others and is raised.

    Args:
        runs: Training runs.
        jobs: Number of worker processes.
        on_result: Called with every run and its result when it is finished.
        on_progress: Called with the number of steps taken since its last call.
        log_folder: TensorBoard's events of a run go to a folder of the run's name in this folder.

    Raises:
        RunError: If a run fails.
    """
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    manager.start(initialize_worker)
    with manager, ProcessPoolExecutor(jobs, mp_context=context, initializer=initialize_worker) as executor:
        reports, stop = manager.Queue(), manager.Event()
        futures = {}
        for run in runs:
            log = None if log_folder is None else log_folder / run.name
            futures[executor.submit(_execute, run, log, reports, stop)] = run
        try:
            _collect(futures, reports, on_result, on_progress)
        except BaseException:
            stop.set()
            executor.shutdown(cancel_futures=True)
            raise


def _execute(run: TrainingRun, log_folder: Path | None, reports: Any, stop: Any) -> RunResult:
    """Executes a run in a worker process; it gives up at its next report after `stop` is set.

    Reports are numbers of steps, and the texts of warnings.
    """
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
        result = execute_run(run, report, log_folder)
    reports.put(unreported)
    return result


def _collect(
    futures: dict[Future, TrainingRun],
    reports: Any,
    on_result: Callable[[TrainingRun, RunResult], None],
    on_progress: Callable[[int], object],
) -> None:
    """Passes reports, warnings and results on until every run is finished; raises the first failure."""
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


def _result(run: TrainingRun, future: Future) -> RunResult:
    """Returns the result of a finished run.

    Raises:
        RunError: If the run failed.
    """
    try:
        return future.result()
    except (BrokenExecutor, RunStopped):
        raise  # not this run's own failure
    except Exception as error:
        raise RunError.of(run.name, error) from error
