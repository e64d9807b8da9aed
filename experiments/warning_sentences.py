"""Warnings as the commands print them: one sentence each, once, on a line of its own above a progress bar."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def warnings_as_sentences() -> Iterator[None]:
    """Prints the text of each warning once on stderr, without the file and the line of code that it comes from."""
    shown: set[str] = set()

    def show(message: Warning | str, *origin: Any, **more: Any) -> None:
        text = " ".join(str(message).split())
        if text not in shown:
            shown.add(text)
            from tqdm import tqdm  # only where there is something to say: `ncs --help` starts sooner

            line = f"ncs: warning: {text}"
            if sys.stderr.isatty():
                from experiments.analysis.terminal_text import wrapped

                line = wrapped(line, indent=5)
            tqdm.write(line, file=sys.stderr)

    with _shown_by(show):
        yield


@contextmanager
def warnings_sent(send: Callable[[str], object]) -> Iterator[None]:
    """Sends the text of each warning, for instance from a worker process to where the progress bar is."""
    with _shown_by(lambda message, *origin, **more: send(str(message))):
        yield


@contextmanager
def _shown_by(show: Callable[..., object]) -> Iterator[None]:
    """Has warnings shown by a function; which ones are shown stays as it is."""
    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
