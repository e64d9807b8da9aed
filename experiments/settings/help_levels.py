"""The two levels of help: what matters first, and everything."""

from __future__ import annotations

from dataclasses import field, fields, make_dataclass
from inspect import cleandoc
from typing import Annotated, Any, get_type_hints

import tyro

# Flag that lists every setting.
HELP_ALL = "--help-all"
# Settings that the first level leaves out: of clusters, and of PPO-Lagrangian.
_LATER = {"ray_address", "ray_wait", "cpus_per_run", "gpus_per_run", "lagrangian"}
_POINTER = f"Settings of Ray and of PPO-Lagrangian are listed by {HELP_ALL}."


def at_help_level(arguments: list[str], kinds: dict[str, Any]) -> tuple[list[str], dict[str, Any]]:
    """Returns the arguments as the parser takes them, and the settings' dataclasses at the level of help asked for.

    Args:
        arguments: Arguments of the command line.
        kinds: Dataclass of each command's settings.
    """
    if HELP_ALL in arguments:
        return ["--help" if each == HELP_ALL else each for each in arguments], kinds
    if not {"-h", "--help"} & set(arguments):
        return arguments, kinds
    return arguments, {name: _first_level(kind) for name, kind in kinds.items()}


def _first_level(kind: Any) -> Any:
    """Returns a dataclass of the same settings, some of which its help leaves out."""
    later = [each for each in fields(kind) if each.name in _LATER]
    if not later:
        return kind
    hints = get_type_hints(kind, include_extras=True)
    hidden = [
        (
            each.name,
            Annotated[hints[each.name], tyro.conf.Suppress],
            field(default=each.default, default_factory=each.default_factory),  # type: ignore[call-overload]
        )
        for each in later
    ]
    text = cleandoc(kind.__doc__).replace("Attributes:", f"{_POINTER}\n\nAttributes:", 1)
    return make_dataclass(kind.__name__, hidden, bases=(kind,), frozen=True, kw_only=True, namespace={"__doc__": text})
