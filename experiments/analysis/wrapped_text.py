"""Prose for a terminal."""

from __future__ import annotations

import shutil
from textwrap import TextWrapper

# Lines follow the terminal between these widths, and have the greatest where there is no terminal.
_LEAST_WIDTH, _GREATEST_WIDTH = 60, 100


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
