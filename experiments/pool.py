"""Runs units in worker processes and shows how far they are."""

from __future__ import annotations

import multiprocessing
import queue
import signal
import sys
from collections.abc import Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from typing import Any

from tqdm import tqdm

from experiments.unit import Unit, UnitResult, run_unit

# How often the progress bar looks for news [s].
REFRESH = 0.5
# Where nobody watches (output to a file), a line this often is enough [s].
QUIET_REFRESH = 20.0


def run_all(units: Sequence[Unit], jobs: int, total_steps: int) -> list[UnitResult]:
    """Returns the results of all units, in their order; the first failure stops the rest and is raised.

    Args:
        units: What to run.
        jobs: Worker processes.
        total_steps: Training and evaluation steps of all units, for the progress bar.
    """
    context = multiprocessing.get_context("spawn")
    interval = REFRESH if sys.stderr.isatty() else QUIET_REFRESH
    with (
        context.Manager() as manager,
        ProcessPoolExecutor(jobs, mp_context=context, initializer=_ignore_interrupts) as executor,
        tqdm(total=total_steps, unit="step", unit_scale=True, mininterval=interval, file=sys.stderr) as bar,
    ):
        news, stop = manager.Queue(), manager.Event()
        futures = [executor.submit(_work, unit, news, stop) for unit in units]
        try:
            _watch(futures, units, news, bar)
            return [future.result() for future in futures]
        except BaseException:
            stop.set()
            executor.shutdown(cancel_futures=True)
            raise


class Stopped(RuntimeError):
    """Another unit failed, or the user interrupted."""


def _ignore_interrupts() -> None:
    """Leaves the reaction to Ctrl-C to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(unit: Unit, news: Any, stop: Any) -> UnitResult:
    """Runs a unit in a worker; it ends at its next report once `stop` is set."""

    def report(steps: int) -> None:
        if stop.is_set():
            raise Stopped(unit.name)
        news.put(steps)

    return run_unit(unit, report)


def _watch(futures: Sequence[Future], units: Sequence[Unit], news: Any, bar: tqdm) -> None:
    """Updates the bar until every future is done or one has failed."""
    told: set[int] = set()
    pending = set(futures)
    while pending:
        done, pending = wait(pending, timeout=REFRESH, return_when=FIRST_EXCEPTION)
        while True:
            try:
                bar.update(news.get_nowait())
            except queue.Empty:
                break
        if any(future.exception() for future in done):
            return
        for i, future in enumerate(futures):
            if future.done() and i not in told:
                told.add(i)
                bar.write(_line(units[i], future.result()), file=sys.stderr)


def _line(unit: Unit, result: UnitResult) -> str:
    violating = sum(episode.violation_steps > 0 for episode in result.episodes)
    mean = sum(episode.episode_return for episode in result.episodes) / len(result.episodes)
    training = f"{result.train_violation_steps:,} violating training steps, " if result.train_steps else ""
    return f"{unit.name}: {training}{violating} of {len(result.episodes)} episodes violating, return {mean:.2f}"
