"""Settings given as NAME=VALUE, of which the command does not know the names: `--channel loss=0.5 delay=3`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

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
