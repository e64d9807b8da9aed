"""What commands show on a terminal: tables, prose, and warnings as sentences."""

from __future__ import annotations

import shutil
import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from textwrap import TextWrapper
from typing import Any

# Lines of prose follow the terminal between these widths, and have the greatest where there is no terminal; columns of
# a table that would be wider than the greatest stand closer together [characters].
_LEAST_WIDTH, _GREATEST_WIDTH = 60, 80


def text_table(rows: Sequence[Sequence[str]], rules: Collection[int] = (1,), left_columns: int = 1) -> str:
    """Returns rows of cells as aligned text.

    Args:
        rows: Rows of equal length, the header first; a row of a single cell is a title, which may be wider than its
            column, of the rows below it.
        rules: Indices of the rows above which a horizontal rule is drawn.
        left_columns: Number of columns that are aligned to the left; the others are aligned to the right.
    """
    widths = [max(map(len, column)) for column in zip(*(row for row in rows if len(row) > 1), strict=True)]
    gaps = len(widths) - 1
    gap = 2 if sum(widths) + 2 * gaps <= _GREATEST_WIDTH else 1
    rule = "-" * (sum(widths) + gap * gaps)
    lines = []
    for index, row in enumerate(rows):
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=len(row) > 1)]
        cells[:left_columns] = [cell.ljust(width) for cell, width in zip(row, widths[:left_columns], strict=False)]
        lines += [rule] * (index in rules) + [(" " * gap).join(cells).rstrip()]
    return "\n".join(lines)


def terminal_width() -> int:
    """Returns how wide lines of prose may be [characters]."""
    columns = shutil.get_terminal_size((_GREATEST_WIDTH, 24)).columns
    return min(max(columns, _LEAST_WIDTH), _GREATEST_WIDTH)


def wrapped(text: str, width: int | None = None, *, label: str = "", indent: int = 2) -> str:
    """Returns a text in lines of at most some width; only a longer word makes a line longer.

    Args:
        text: The text, on one line.
        width: Greatest width of a line [characters]; by default that of the terminal.
        label: What stands in front of the text.
        indent: Column in which the second and later lines begin, and the first one if there is a label.
    """
    wrapper = TextWrapper(
        terminal_width() if width is None else width,
        initial_indent=label and label.ljust(indent),
        subsequent_indent=" " * indent,
        break_on_hyphens=False,
        break_long_words=False,
    )
    return wrapper.fill(text)


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
            tqdm.write(wrapped(line, indent=5) if sys.stderr.isatty() else line, file=sys.stderr)

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
