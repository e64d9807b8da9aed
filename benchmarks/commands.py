"""Makes commands of functions, and prints tables: `python -m benchmarks.MODULE COMMAND --help` says what each does.

A command is a function with a docstring whose parameters are its options, as `ncs` has them (tyro).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import tyro


def run(doc: str | None, commands: Sequence[Callable[..., Any]], args: Sequence[str] | None = None) -> Any:
    """Runs the command that is asked for, of the command line by default, without warnings; returns what it returns."""
    by_name = {command.__name__.replace("_", "-"): command for command in commands}
    with warnings.catch_warnings(action="ignore"):
        return tyro.extras.subcommand_cli_from_dict(by_name, description=doc, args=args)


def one_of(names: Sequence[str]) -> Any:
    """Returns what an option is annotated with that takes one of some names."""
    return tyro.conf.arg(constructor=tyro.extras.literal_type_from_choices(names))


def some_of(names: Sequence[str]) -> Any:
    """Returns what an option is annotated with that takes some of some names."""
    return tyro.conf.arg(constructor=tuple[tyro.extras.literal_type_from_choices(names), ...])  # type: ignore[misc]


def table(*titles: str, first: int = 28, width: int = 9) -> Callable[..., None]:
    """Prints the titles of a table and returns what prints a row: a row is seen as soon as it is known.

    Args:
        titles: Of the columns, at least `width` wide and as wide as their title.
        first: Width of the first column.
        width: Least width of the others.
    """
    widths = [max(width, 2 + len(each)) for each in titles[1:]]

    def show(name: object, *cells: object) -> None:
        aligned = (f"{cell!s:>{each}}" for cell, each in zip(cells, widths, strict=True))
        print(f"{name!s:{first}}" + "".join(aligned), flush=True)

    show(*titles)
    return show
