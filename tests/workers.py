"""Worker processes that are none: what a command gives them runs in this process, which has imported everything.

For tests of what a command does; that results do not depend on the process is tested where worker processes are.
"""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any
from unittest import mock

from experiments.backends.execution import Engine, executed


@contextlib.contextmanager
def _here(jobs: int, counts: Any, log_folder: Path | None = None) -> Iterator[Engine]:
    """Executes at once what is submitted; runs and results are pickled as on their way to a process and back."""

    def submit(number: int, run: Any) -> Future:
        future: Future = Future()
        try:
            result = executed(pickle.loads(pickle.dumps(run)), lambda steps: None, log_folder)
            future.set_result(pickle.loads(pickle.dumps(result)))
        except Exception as error:
            future.set_exception(error)
        return future

    yield submit, BrokenProcessPool


@contextlib.contextmanager
def no_worker_processes() -> Iterator[None]:
    """Commands execute their training runs in this process."""
    with mock.patch("experiments.backends.execution.local_workers", _here):
        yield
