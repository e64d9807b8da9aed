"""What tests use to do something at a line of the project's own code while a call is under way."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tests.certificates import ROOT

PACKAGES = tuple(f"{ROOT / package}/" for package in ("ncs_gym", "shields", "agents"))


class Interruption(BaseException):
    """Like Ctrl-C, a signal, or a panic of native code: no Exception."""


@contextmanager
def tracing(seen: Callable[[str, int], None]) -> Iterator[None]:
    """Calls a function with the file and the number of each line of the project that is about to be executed."""

    def trace(frame: Any, event: str, _: Any) -> Any:
        if not frame.f_code.co_filename.startswith(PACKAGES):
            return None
        if event == "line":
            seen(frame.f_code.co_filename, frame.f_lineno)
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)


def places(call: Callable[[], Any], stride: int = 1, *within: str) -> list[int]:
    """Where each line is executed for the first time in a call, counted in lines.

    Args:
        call: What is called.
        stride: Of the lines every how-manieth.
        within: Parts of the names of the files whose lines count; all by default.
    """
    first: dict[tuple[str, int], int] = {}
    count = 0

    def note(file: str, line: int) -> None:
        nonlocal count
        if any(part in file for part in within or ("",)):
            first.setdefault((file, line), count)
        count += 1

    with tracing(note):
        call()
    return sorted(first.values())[::stride]


def at(place: int, action: Callable[[], None], call: Callable[[], Any]) -> Any:
    """Returns what a call returns in the course of which, at a place, something else is done."""
    count = 0

    def wait(file: str, line: int) -> None:
        nonlocal count
        count += 1
        if count == place + 1:
            action()

    with tracing(wait):
        return call()


def interrupt(place: int, call: Callable[[], Any]) -> bool:
    """Begins a call that is interrupted at a place; returns whether it got there: what is remembered shortens calls."""

    def raising() -> None:
        raise Interruption

    try:
        at(place, raising, call)
    except Interruption:
        return True
    return False
