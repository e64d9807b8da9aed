"""Python programs, run in this process, which has imported everything, as in one of their own."""

from __future__ import annotations

import contextlib
import io
import runpy
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import gymnasium as gym


@contextlib.contextmanager
def _started_with(*arguments: str) -> Iterator[io.StringIO]:
    """What a program prints that is given some arguments; neither ids that it registers nor its files outlive it."""
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        mock.patch.object(sys, "argv", [*arguments]),
        mock.patch.dict(gym.registry),
        contextlib.redirect_stdout(io.StringIO()) as printed,
    ):
        yield printed


def output_of_file(path: Path, *arguments: str) -> str:
    """What the program in a file prints."""
    with _started_with(str(path), *arguments) as printed:
        runpy.run_path(str(path), run_name="__main__")
    return printed.getvalue()


def output_of(source: str) -> str:
    """What the text of a program prints."""
    with _started_with("program") as printed:
        exec(compile(source, "program", "exec"), {"__name__": "__main__"})
    return printed.getvalue()
