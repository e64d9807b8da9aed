"""What commands show on a terminal: tables, prose, messages beside a progress bar, errors and warnings as sentences."""

from __future__ import annotations

import shutil
import sys
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm

# Lines of prose follow the terminal between these widths, and have the greatest where there is no terminal; no table is
# wider than the greatest [characters].
_LEAST_WIDTH, GREATEST_WIDTH = 60, 80
# Period of the progress bar on a terminal and in a file [s].
_TERMINAL_PERIOD, _FILE_PERIOD = 0.5, 20.0


def text_table(rows: Sequence[Sequence[str]], rules: Collection[int] = (1,), left_columns: int = 1) -> str:
    """Returns rows of cells as aligned text; columns that would make it wider than 80 stand closer together.

    Args:
        rows: Rows of equal length, the header first; a row of a single cell is a title of the rows below it.
        rules: Indices of the rows above which a horizontal rule is drawn.
        left_columns: How many columns are aligned to the left.
    """
    widths = [max(map(len, column)) for column in zip(*(row for row in rows if len(row) > 1), strict=True)]
    gap = 2 if sum(widths) + 2 * (len(widths) - 1) <= GREATEST_WIDTH else 1
    rule = "-" * (sum(widths) + gap * (len(widths) - 1))
    lines = []
    for index, row in enumerate(rows):
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=len(row) > 1)]
        cells[:left_columns] = [cell.ljust(width) for cell, width in zip(row, widths[:left_columns], strict=False)]
        lines += [rule] * (index in rules) + [(" " * gap).join(cells).rstrip()]
    return "\n".join(lines)


def wrapped(text: str, *, label: str = "", indent: int = 2) -> str:
    """Returns a text in lines of the terminal's width; a longer word, or a number and its percent sign, stay whole.

    Args:
        text: The text, on one line.
        label: What stands in front of the text.
        indent: Column in which the second and later lines begin, and the first one if there is a label.
    """
    columns = shutil.get_terminal_size((GREATEST_WIDTH, 24)).columns
    wrapper = TextWrapper(
        min(max(columns, _LEAST_WIDTH), GREATEST_WIDTH),
        initial_indent=label and label.ljust(indent),
        subsequent_indent=" " * indent,
        break_on_hyphens=False,
        break_long_words=False,
    )
    return wrapper.fill(text.replace(" %", "\0%")).replace("\0", " ")


def sentence_of(error: BaseException) -> str:
    """Returns an error as one printable line; only unexpected errors show their type."""
    from ncs_gym.validation import printable

    ours = type(error).__module__.partition(".")[0] == "experiments"
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    elif ours or isinstance(error, (ValueError, OSError, ImportError)):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error} (NCS_DEBUG=1 shows the traceback)"
    return printable(" ".join(text.split()))


def say(line: str, indent: int = 2) -> None:
    """Prints a message on stderr, above a progress bar; on a terminal in lines of its width."""
    from tqdm import tqdm  # only where there is something to say: `ncs --help` starts sooner

    tqdm.write(wrapped(line, indent=indent) if sys.stderr.isatty() else line, file=sys.stderr)


def progress_bar(steps: int, description: str) -> tqdm:
    """Returns a progress bar on stderr: a line that changes on a terminal, in a file a line of its own now and then."""
    from tqdm import tqdm

    is_terminal = sys.stderr.isatty()
    return tqdm(
        total=steps,
        desc=description,
        unit=" step",
        unit_scale=True,
        bar_format="{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_noinv_fmt}]",
        mininterval=_TERMINAL_PERIOD if is_terminal else _FILE_PERIOD,
        miniters=0,
        file=sys.stderr if is_terminal else _Lines(),
    )


class _Lines:
    """Writes to stderr what a progress bar would write over itself, in lines."""

    def write(self, text: str) -> None:
        if line := text.strip("\r\n "):
            sys.stderr.write(f"{line}\n")

    def flush(self) -> None:
        sys.stderr.flush()


@contextmanager
def warnings_as_sentences() -> Iterator[None]:
    """Prints the text of each warning once on stderr."""
    shown: set[str] = set()

    def show(message: Warning | str, *origin: Any, **more: Any) -> None:
        text = " ".join(str(message).split())
        if text not in shown:
            shown.add(text)
            say(f"ncs: warning: {text}", indent=5)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
