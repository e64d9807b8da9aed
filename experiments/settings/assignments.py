"""Settings given as NAME=VALUE, of which the command does not know the names: `--channel loss=0.5 delay=3`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from agents.former_settings import FORMER_FLAGS, from_former
from agents.hyperparams import literal, with_changes
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
        found[name] = literal(value)
    return found


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


def with_assignments(arguments: list[str]) -> list[str]:
    """Returns a command line in which the settings of a group are assignments behind one flag.

    `--channel.loss 0.5 --channel.burst-length=4` becomes `--channel loss=0.5 burst_length=4`, and the former
    `--ppo.discount 0.9` becomes `--hyperparams gamma=0.9`.

    Args:
        arguments: Arguments of the command.
    """
    arguments, found = _without_group(arguments, "--channel")
    arguments = _with_values(arguments, "--channel", found)
    split = [part for each in arguments for part in (each.split("=", 1) if each.startswith("--algo=") else [each])]
    algorithm = next((value for flag, value in pairwise(split) if flag == "--algo"), None)
    for flag, usual in FORMER_FLAGS.items():
        arguments, found = _without_group(arguments, flag)
        former = {name: literal(value) for name, value in found.items()}
        arguments = _with_values(arguments, "--hyperparams", from_former(algorithm or usual, former))
    return arguments


def beside_those_of_file(settings: Any, of_file: Any) -> Any:
    """Returns a command's settings in which the assignments of a settings file hold where none are given.

    Hyperparameters of the file are for its algorithm alone, and give way to a file of hyperparameters.

    Args:
        settings: Settings of the command line; those of the file are their defaults.
        of_file: Settings of the file.
    """
    merged = {
        name: with_changes(getattr(of_file, name), getattr(settings, name))
        for name in ("channel", "hyperparams")
        if hasattr(settings, name)
    }
    if "hyperparams" in merged and (settings.algo != of_file.algo or settings.conf_file is not None):
        merged["hyperparams"] = {} if settings.hyperparams == of_file.hyperparams else settings.hyperparams
    return replace(settings, **merged)


def _without_group(arguments: list[str], flag: str) -> tuple[list[str], dict[str, str]]:
    """Returns a command line without `--flag.name value` and `--flag.name=value`, and their values by name."""
    others, found, waiting = [], {}, iter(arguments)
    for each in waiting:
        name, equals, value = each.partition("=")
        if name.startswith(f"{flag}."):
            found[name.removeprefix(f"{flag}.").replace("-", "_")] = value if equals else next(waiting, "")
        else:
            others.append(each)
    return others, found


def _with_values(arguments: list[str], flag: str, values: Mapping[str, Any]) -> list[str]:
    """Returns a command line with assignments behind a flag, in front of those that are there."""
    texts = [f"{name}={value}" for name, value in values.items()]
    if not texts or flag not in arguments:
        return [*arguments, flag, *texts] if texts else arguments
    place = arguments.index(flag) + 1
    return [*arguments[:place], *texts, *arguments[place:]]
