"""The output folder of a command, in which results of other settings are not replaced."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from experiments.settings import lasting_settings
from shields.documents import write_atomically

# Files by which a folder is known to hold results.
_RESULTS = ("summary.json", "runs/*.json")
# Settings that may change in the same folder: results of runs that are there become part of others.
_FREE = {"seeds", "arms", "baselines", "losses", "delays"}
# Differences that a message lists.
_MOST_LISTED = 3


def claim_folder(command: str, settings: Any) -> None:
    """Creates the output folder of a command and writes `settings.json` in it; an earlier summary is removed.

    Raises:
        ValueError: If the folder holds results of other settings, or a `settings.json` of something else, and
            the settings do not `force` it.
        OSError: If the folder cannot be written.
    """
    folder = settings.out
    content = {"command": command, "settings": lasting_settings(settings)}
    if not settings.force and (problem := _problem(folder, content)):
        raise ValueError(f"{folder} holds {problem}: give another --out, or --force to replace it")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "summary.json").unlink(missing_ok=True)
    write_json(folder / "settings.json", content)


def _problem(folder: Path, content: dict[str, Any]) -> str:
    """Returns what a folder holds that a command would replace."""
    has_results, file = any(file for name in _RESULTS for file in folder.glob(name)), folder / "settings.json"
    if not (has_results or file.exists()):
        return ""
    try:
        before = json.loads(file.read_bytes())
        command, kept, own = before["command"], dict(before["settings"]), content["settings"]
    except (OSError, LookupError, TypeError, ValueError, RecursionError):
        return "results without their settings.json" if has_results else "another settings.json"
    if not has_results:
        return ""
    if command != content["command"]:
        return f"results of ncs {command}"
    names = sorted(name for name in (kept.keys() | own.keys()) - _FREE if kept.get(name) != own.get(name))
    others = [f"{name} {kept.get(name)}, now {own.get(name)}" for name in names]
    listed = "; ".join([*others[:_MOST_LISTED], *["..."] * (len(others) > _MOST_LISTED)])
    return listed and f"results of other settings ({listed})"


def write_json(path: Path | None, content: Any) -> None:
    """Writes JSON values into a file if there is a path."""
    if path is not None:
        write_atomically(path, json.dumps(content, indent=1) + "\n")


def write_results(
    folder: Path,
    summary: dict[str, Any],
    files: Mapping[str, str | bytes] = MappingProxyType({}),
    figures: Mapping[str, tuple[str, bytes]] = MappingProxyType({}),
) -> None:
    """Writes what a command leaves; summary.json comes last, so that it stands for complete results."""
    (folder / "figures").mkdir(exist_ok=True)
    for name, (_, png) in figures.items():
        write_atomically(folder / "figures" / f"{name}.png", png)
    for name, content in files.items():
        write_atomically(folder / name, content)
    write_atomically(folder / "summary.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")


def require_place(path: Path | None) -> None:
    """Fails early: raises OSError if there is a folder in the place of a file, or no folder to write it in."""
    if path is None:
        return
    folder, number = path.parent, 0
    if path.is_dir():
        folder, number = path, errno.EISDIR
    elif not folder.is_dir():
        number = errno.ENOTDIR if folder.exists() else errno.ENOENT
    elif not os.access(folder, os.W_OK):
        number = errno.EACCES
    if number:
        raise OSError(number, os.strerror(number), str(folder))
