"""Runs units in worker processes and shows how far they are."""

from __future__ import annotations

import multiprocessing
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from multiprocessing.managers import SyncManager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from experiments.backends.progress import REFRESH, progress_bar, show_result
from experiments.backends.worker_init import belong_to_parent
from experiments.errors import RunError, RunStopped
from experiments.runs.training_run import Unit, UnitResult, run_unit

# Workers tell about at least this many steps at a time.
NEWSWORTHY = 1000


def run_all(
    units: Sequence[Unit],
    jobs: int,
    total_steps: int,
    on_result: Callable[[Unit, UnitResult], None],
    log_folder: Path | None = None,
) -> None:
    """Runs all units; the first failure stops the rest and is raised.

    Args:
        units: What to run.
        jobs: Worker processes.
        total_steps: Training and evaluation steps of all units, for the progress bar.
        on_result: Called with every unit and its result as soon as it is there.
        log_folder: TensorBoard's events of a unit go to a folder in it, of the unit's name.

    Raises:
        RunError: If a unit fails.
    """
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    manager.start(belong_to_parent)
    with (
        manager,
        ProcessPoolExecutor(jobs, mp_context=context, initializer=belong_to_parent) as executor,
        progress_bar(total_steps) as bar,
    ):
        news, stop = manager.Queue(), manager.Event()
        logs = [None if log_folder is None else log_folder / unit.name for unit in units]
        futures = [executor.submit(_work, unit, log, news, stop) for unit, log in zip(units, logs, strict=True)]
        try:
            _watch(dict(zip(futures, units, strict=True)), news, bar, on_result)
        except BaseException:
            stop.set()
            executor.shutdown(cancel_futures=True)
            raise


def _work(unit: Unit, log_folder: Path | None, news: Any, stop: Any) -> UnitResult:
    """Runs a unit in a worker; it ends at its next report once `stop` is set."""
    due = 0

    def report(steps: int) -> None:
        nonlocal due
        due += steps
        if due >= NEWSWORTHY:
            if stop.is_set():
                raise RunStopped(f"{unit.name} gave up: another unit failed, or the user interrupted")
            news.put(due)
            due = 0

    result = run_unit(unit, report, log_folder)
    news.put(due)
    return result


def _watch(units: dict[Future, Unit], news: Any, bar: tqdm, on_result: Callable[[Unit, UnitResult], None]) -> None:
    """Updates the bar and hands results on until every future is done; raises the first failure."""
    pending = set(units)
    while pending:
        done, pending = wait(pending, timeout=REFRESH, return_when=FIRST_COMPLETED)
        while True:
            try:
                bar.update(news.get_nowait())
            except queue.Empty:
                break
        for future in sorted(done, key=lambda one: one.exception() is not None):
            result = _result(units[future], future)
            on_result(units[future], result)
            show_result(bar, units[future], result)


def _result(unit: Unit, future: Future) -> UnitResult:
    """Returns the result of a finished unit.

    Raises:
        RunError: If it failed.
    """
    try:
        return future.result()
    except (BrokenExecutor, RunStopped):
        raise  # not its own fault
    except Exception as error:
        raise RunError.of(unit.name, error) from error
