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

from experiments.attack import monte_carlo_batch
from experiments.backends.execution import LocalWorkers
from experiments.backends.worker import execute_here
from experiments.commands import attack


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
def no_worker_processes() -> Iterator[None]:
    """Commands execute their training runs and batches in this process."""
    with mock.patch("experiments.backends.execution.local_workers", _here):
        yield


def replace_cases(monkeypatch: Any, cases: dict[str, Any]) -> None:
    """Has `ncs attack` attack these cases instead of its own."""
    for module in (monte_carlo_batch, attack):
        monkeypatch.setattr(
            module, "cases_of", lambda settings: {name: case.with_delta(settings.delta) for name, case in cases.items()}
        )
