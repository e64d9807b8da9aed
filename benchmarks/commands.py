"""Makes commands of functions, and prints tables: `python -m benchmarks.MODULE COMMAND --help` says what each does.

A command is a function with a docstring whose parameters are its options: `--seconds 2` for `seconds: float = 1.0`,
`--brief` for `brief: bool = False`, several values for a `Sequence`, and values without a name for `*names: str`. What
an `Annotated` type carries are the values allowed.
"""

from __future__ import annotations

import argparse
import inspect
import warnings
from collections.abc import Callable, Sequence
from types import NoneType
from typing import Annotated, Any, get_args, get_origin


def parser_of(doc: str | None, commands: Sequence[Callable[..., None]]) -> argparse.ArgumentParser:
    """Returns the parser of a module's commands."""
    shown: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter}
    parser = argparse.ArgumentParser(description=doc, **shown)
    chosen = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in commands:
        text = inspect.getdoc(command) or ""
        brief = text.partition("\n")[0].replace("%", "%%")
        own = chosen.add_parser(command.__name__.replace("_", "-"), help=brief, description=text, **shown)
        own.set_defaults(command=command)
        for each in inspect.signature(command, eval_str=True).parameters.values():
            if each.kind is each.VAR_POSITIONAL:
                own.add_argument(each.name, nargs="*", type=each.annotation)
            else:
                own.add_argument(f"--{each.name.replace('_', '-')}", default=each.default, **_kind_of(each.annotation))
    return parser


def _kind_of(annotation: Any) -> dict[str, Any]:
    """Returns how an option of a type is parsed."""
    choices = None
    if get_origin(annotation) is Annotated:
        annotation, choices = get_args(annotation)
    if annotation is bool:
        return {"action": "store_true"}
    if NoneType in get_args(annotation):
        annotation = get_args(annotation)[0]
    more = {"choices": choices, "metavar": "NAME", "help": ", ".join(choices)} if choices else {}
    if get_origin(annotation) is Sequence:
        return {"nargs": "+", "type": get_args(annotation)[0]} | more
    return {"type": annotation} | more


def run(doc: str | None, commands: Sequence[Callable[..., None]]) -> None:
    """Runs the command that is asked for, without warnings."""
    given = vars(parser_of(doc, commands).parse_args())
    command = given.pop("command")
    parameters = inspect.signature(command).parameters.values()
    positional = [value for each in parameters if each.kind is each.VAR_POSITIONAL for value in given.pop(each.name)]
    warnings.simplefilter("ignore")
    command(*positional, **given)


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
