"""Worker processes that are none: what a command gives them runs in this process, which has imported everything.

For tests of what a command does; that results do not depend on the process is tested where worker processes are.
"""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from queue import Queue
from threading import Event
from typing import Any
from unittest import mock

from experiments.attack import monte_carlo_batch
from experiments.commands import attack


class _Executor(Executor):
    """Executes at once what is submitted; arguments and results are pickled as on their way to a process and back."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        pass

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future:
        future: Future = Future()
        sent = [each if isinstance(each, Queue | Event) else pickle.loads(pickle.dumps(each)) for each in arguments]
        try:
            future.set_result(pickle.loads(pickle.dumps(function(*sent))))
        except Exception as error:
            future.set_exception(error)
        return future


class _Manager:
    """Makes queues and events of this process."""

    Queue, Event = Queue, Event

    def __init__(self, **settings: Any) -> None:
        pass

    def start(self, initializer: Callable[[], None]) -> None:
        pass

    def __enter__(self) -> _Manager:
        return self

    def __exit__(self, *error: object) -> None:
        pass


@contextlib.contextmanager
def no_worker_processes(*, evaluates_on_the_way: bool = False) -> Iterator[None]:
    """Commands execute their training runs and batches in this process.

    Evaluations on the way take most of a short training and change no result (tests/agents/test_training.py): they are
    left out unless they are asked for.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch("experiments.backends.execution.ProcessPoolExecutor", _Executor))
        stack.enter_context(mock.patch("experiments.backends.execution.SyncManager", _Manager))
        if not evaluates_on_the_way:
            from agents import training

            stack.enter_context(mock.patch.object(training, "EvaluationCallback", _no_evaluation))
        yield


def _no_evaluation(*settings: Any) -> Any:
    from agents.callbacks import RegularCallback

    return RegularCallback(lambda: None)


def replace_cases(monkeypatch: Any, cases: dict[str, Any]) -> None:
    """Has `ncs attack` attack these cases instead of its own."""
    for module in (monte_carlo_batch, attack):
        monkeypatch.setattr(
            module, "cases_of", lambda settings: {name: case.with_delta(settings.delta) for name, case in cases.items()}
        )
