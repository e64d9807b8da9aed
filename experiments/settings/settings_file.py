"""Settings of a run in a file, from which the same run can be started again."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from experiments.errors import SettingsError
from ncs_gym.validation import LONGEST_QUOTE
from shields.atomic_write import write_atomically

FORMAT = "ncs-gym settings 1"
FLAG = "--config"


def settings_json(command: str, settings: Any) -> dict[str, Any]:
    """Returns a command's settings as JSON values."""
    values = json.loads(json.dumps(asdict(settings), default=str))
    return {"format": FORMAT, "command": command, "settings": {k: v for k, v in values.items() if k != "config"}}


def save_settings(path: Path, command: str, settings: Any) -> None:
    """Writes a command's settings.

    Raises:
        OSError: If the file cannot be written.
    """
    write_atomically(path, json.dumps(settings_json(command, settings), indent=1) + "\n")


def with_config(arguments: list[str], parse: Callable[[list[str]], Any] | None = None) -> list[str]:
    """Returns the command line with `--config FILE` replaced by the flags in the file, before the user's own flags.

    Args:
        arguments: The command line.
        parse: Returns the settings that a command line stands for, or exits; None does not look at the values.

    Raises:
        SettingsError: If the file is missing, damaged or another command's, or holds what `parse` does not take.
    """
    given = [i for i, argument in enumerate(arguments) if argument == FLAG or argument.startswith(f"{FLAG}=")]
    if not given or not arguments[0:1] or arguments[0].startswith("-"):
        return arguments
    if len(given) > 1:
        raise SettingsError(f"{FLAG} is given {len(given)} times")
    at = given[0]
    value = arguments[at].partition("=")[2] or "".join(arguments[at + 1 : at + 2])
    if not value or value.startswith("--"):
        raise SettingsError(f"{FLAG} needs a file")
    rest = arguments[1:at] + arguments[at + (1 if "=" in arguments[at] else 2) :]
    command, values = arguments[0], _read(Path(value), arguments[0])
    if parse is not None:
        _require_meaning(Path(value), command, values, parse)
    return [command, *_flags(values), *rest]


def _require_meaning(path: Path, command: str, values: dict[str, Any], parse: Callable[[list[str]], Any]) -> None:
    """Raises unless every value in a file is what the command makes of its flag.

    Raises:
        SettingsError: Naming the first that is not.
    """
    for name, value in values.items():
        flags, unheard = _flags({name: value}), io.StringIO()
        try:
            with contextlib.redirect_stdout(unheard), contextlib.redirect_stderr(unheard):
                read = settings_json(command, parse([command, *flags]))["settings"]
        except (SystemExit, ValueError):
            read = {}
        if name not in read or not _is_same(value, read[name]):
            text = " ".join(f"{name} = {json.dumps(value)}".split())
            raise SettingsError(f"settings {path} hold what ncs {command} does not take: {text[:LONGEST_QUOTE]}")


def _is_same(given: Any, read: Any) -> bool:
    """Returns whether a value in a file means what was read; what is not given in it is not compared."""
    if isinstance(given, dict) and isinstance(read, dict):
        return all(key in read and _is_same(value, read[key]) for key, value in given.items())
    if isinstance(given, list) and isinstance(read, list):
        return len(given) == len(read) and all(map(_is_same, given, read))
    if isinstance(given, str) and isinstance(read, str):
        return given == read or str(Path(given)) == read
    return isinstance(given, bool) == isinstance(read, bool) and given == read


def _read(path: Path, command: str) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise SettingsError(f"cannot read settings {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"settings {path} are damaged: not valid JSON") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise SettingsError(f"{path} is not of format {FORMAT!r}")
    if document.get("command") != command or not isinstance(document.get("settings"), dict):
        raise SettingsError(f"{path} holds settings of ncs {document.get('command')}, not of ncs {command}")
    return document["settings"]


def _flags(values: dict[str, Any], prefix: str = "--") -> list[str]:
    """Returns settings as command-line flags; the parser checks them like a user's."""
    flags: list[str] = []
    for name, value in values.items():
        texts = [each for each in (value if isinstance(value, list) else [value]) if isinstance(each, str)]
        if any(text.startswith("-") for text in [name, *texts]):
            raise SettingsError(f"the settings hold a value that is none: {name} = {value!r}")
        flag = prefix + name.replace("_", "-")
        if isinstance(value, dict):
            flags += _flags(value, flag + ".")
        elif isinstance(value, bool):
            flags.append(flag if value else f"{prefix}no-{name.replace('_', '-')}")
        elif isinstance(value, list):
            flags += [flag, *map(str, value)]
        else:
            flags += [flag, repr(value) if isinstance(value, float) else str(value)]
    return flags
