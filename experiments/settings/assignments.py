"""Settings given as NAME=VALUE, of which the command does not know the names: `--channel loss=0.5 delay=3`."""

from __future__ import annotations

import ast
import json
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from ncs_gym.validation import shown


def _assignments(texts: list[str]) -> dict[str, Any]:
    """Returns the values by name: Python's numbers, lists, dictionaries, True, False and None; otherwise the text.

    Raises:
        ValueError: If a text is no NAME=VALUE, or a name is given twice.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (equals and name.isidentifier()):
            raise ValueError(f"expected NAME=VALUE, such as gamma=0.99, got {shown(text)}")
        if name in found:
            raise ValueError(f"{name} is given twice")
        found[name] = _value(value)
    return found


def _value(text: str) -> Any:
    """Returns what a text stands for; the text itself if it is no literal, or none that a file of JSON can keep."""
    try:
        value = ast.literal_eval(text)
        return json.loads(json.dumps(value, allow_nan=False))
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
        return text


Assignments = Annotated[
    dict[str, Any],
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME=VALUE [NAME=VALUE ...]]",
        instance_from_str=_assignments,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda values: [f"{name}={value}" for name, value in values.items()],
    ),
]


def dotted_as_assignments(arguments: list[str], flag: str) -> list[str]:
    """Returns a command line in which the settings of a group are assignments behind one flag.

    `--channel.loss 0.5 --channel.burst-length=4` becomes `--channel loss=0.5 burst_length=4`.

    Args:
        arguments: Arguments of the command.
        flag: The flag of the group, "--channel".
    """
    others, found, waiting = [], [], iter(arguments)
    for each in waiting:
        name, equals, value = each.partition("=")
        if not name.startswith(f"{flag}."):
            others.append(each)
            continue
        value = value if equals else next(waiting, "")
        found.append(f"{name.removeprefix(f'{flag}.').replace('-', '_')}={value}")
    if not found:
        return arguments
    if flag in others:  # behind what is given in the present form
        place = others.index(flag) + 1
        return [*others[:place], *found, *others[place:]]
    return [*others, flag, *found]
