"""What a worker process does; imports nothing large before it has begun, so that it ends at once when it is told to."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from experiments.runs.run_store import Run

# Smallest number of steps that a worker reports at a time.
_REPORTED_STEPS = 1000


@dataclass(frozen=True)
class Outcome:
    """What came of a run: its result, or its error."""

    result: Any = None
    error: BaseException | None = None


def initialize_worker() -> None:
    """Leaves the reaction to Ctrl-C to the parent, and ends this process when its parent ends, however that happens."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    parent = multiprocessing.parent_process()

    def wait_for_parent() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Has Ctrl-C and SIGTERM wait: a process that is started is not interrupted before `initialize_worker`.

    The process inherits that they are blocked. Here another thread may get one, whose handler then runs in the main
    thread: the handlers wait as well.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # which is started with the first process, and unblocks signals then
    numbers, came = (signal.SIGINT, signal.SIGTERM), list[int]()
    before, handlers = signal.pthread_sigmask(signal.SIG_BLOCK, numbers), {}
    if threading.current_thread() is threading.main_thread():
        handlers = {number: signal.signal(number, lambda each, frame: came.append(each)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number in came:
            signal.raise_signal(number)


def work(parent: Connection, told: Connection, log_folder: Path | None) -> None:
    """Executes the runs that are sent, one after the other, until the other end of `told` is closed."""
    initialize_worker()
    try:
        while told not in wait([parent, told]):
            outcome = _outcome(parent, told, log_folder)
            try:
                parent.send(outcome)
            except (EOFError, OSError):
                raise
            except Exception as error:
                parent.send(Outcome(error=RuntimeError(f"what came of the run cannot be sent: {error}")))
    except (EOFError, OSError):  # the parent has gone
        os._exit(1)


def _outcome(parent: Connection, told: Connection, log_folder: Path | None) -> Outcome:
    try:
        run = parent.recv()
    except (EOFError, OSError):
        raise
    except Exception as error:
        return Outcome(error=error)
    try:
        return Outcome(execute_here(run, parent.send, told.poll, log_folder))
    except Exception as error:
        error.add_note(traceback.format_exc())
        return Outcome(error=error)


def execute_here(
    run: Run, send: Callable[[int | str], object], is_told: Callable[[], bool], log_folder: Path | None
) -> Any:
    """Returns the result of a run, and sends steps taken and warnings; it gives up at a report after it was told to.

    Args:
        run: The run.
        send: Sends a number of steps, or the text of a warning.
        is_told: Whether to give up; asked at reports of at least a thousand steps, and of none.
        log_folder: Folder in which it leaves TensorBoard's events; None for none.

    Raises:
        RunStopped: If it gave up.
    """
    from experiments.errors import RunStopped
    from experiments.terminal import warnings_sent

    unreported = 0

    def report(steps: int) -> None:
        nonlocal unreported
        unreported += steps
        if unreported >= _REPORTED_STEPS or not steps:
            if is_told():
                raise RunStopped(f"{run.name} gave up: another run failed, or the user interrupted")
            send(unreported)
            unreported = 0

    with warnings_sent(send):
        result = run.execute(report, log_folder)
    send(unreported)
    return result
