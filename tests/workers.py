"""Worker processes that are none: what a command gives them runs in this process, which has imported everything.

For tests of what a command does; that results do not depend on the process is tested where worker processes are.
"""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any
from unittest import mock

from experiments.backends.execution import LocalWorkers
from experiments.backends.worker import execute_here


class _Here(LocalWorkers):
    """Executes at once what is submitted; runs and results are pickled as on their way to a process and back."""

    def __init__(self, log_folder: Path | None) -> None:
        super().__init__(log_folder)
        self._folder, self._sent = log_folder, []

    def submit(self, run: Any) -> Future:
        future: Future = Future()
        try:
            result = execute_here(pickle.loads(pickle.dumps(run)), self._sent.append, lambda: False, self._folder)
            future.set_result(pickle.loads(pickle.dumps(result)))
        except Exception as error:
            future.set_exception(error)
        return future

    def reports(self) -> Iterator[int | str]:
        while self._sent:
            yield self._sent.pop(0)


@contextlib.contextmanager
def _here(workers: int, log_folder: Path | None = None) -> Iterator[_Here]:
    yield _Here(log_folder)


@contextlib.contextmanager
def no_worker_processes(*, evaluates_on_the_way: bool = False) -> Iterator[None]:
    """Commands execute their training runs in this process.

    Evaluations on the way take most of a short training and change no result (tests/agents/test_training.py): they are
    left out unless they are asked for.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch("experiments.backends.execution.local_workers", _here))
        if not evaluates_on_the_way:
            from agents import training

            stack.enter_context(mock.patch.object(training, "EvaluationCallback", _no_evaluation))
        yield


def _no_evaluation(*settings: Any) -> Any:
    from agents.callbacks import RegularCallback

    return RegularCallback(lambda: None)
