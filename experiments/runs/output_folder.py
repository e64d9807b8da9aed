"""The output folder of a command: results of other settings in it are not replaced, finished runs not done again."""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from experiments.errors import OtherResultsError
from experiments.settings import lasting_settings
from experiments.terminal import say
from shields.atomic_write import write_atomically

# Files by which a folder is known to hold results.
_RESULTS = ("summary.json", "runs/*.json", "tensorboard/*/checkpoint/history.json")
# Settings that may change in the same folder: results of runs that are there become part of others.
_FREE = {"seeds", "arms", "baselines", "losses", "delays"}
# Differences that a message lists.
_MOST_LISTED = 3


def claim_folder(command: str, settings: Any) -> None:
    """Creates the output folder of a command and writes `settings.json` in it; an earlier summary is removed.

    Args:
        command: Name of the command.
        settings: Its complete settings; with `force` the folder is taken in any case.

    Raises:
        OtherResultsError: If the folder holds results of other settings, or a `settings.json` of something else.
        OSError: If the folder cannot be written.
    """
    folder, file = settings.out, settings.out / "settings.json"
    content = {"command": command, "settings": lasting_settings(settings)}
    if not settings.force and (problem := _problem(folder, content)):
        raise OtherResultsError(f"{folder} holds {problem}: give another --out, or --force to replace it")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "summary.json").unlink(missing_ok=True)
    write_atomically(file, json.dumps(content, indent=1) + "\n")


def _problem(folder: Path, content: dict[str, Any]) -> str:
    """Returns what a folder holds that a command would replace; empty if there is nothing."""
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


def write_results(
    folder: Path,
    summary: dict[str, Any],
    files: Mapping[str, str | bytes] = MappingProxyType({}),
    figures: Mapping[str, tuple[str, bytes]] = MappingProxyType({}),
) -> None:
    """Writes what a command leaves; summary.json comes last, so that it stands for complete results.

    Raises:
        OSError: If a file cannot be written.
    """
    (folder / "figures").mkdir(exist_ok=True)
    for name, (_, png) in figures.items():
        write_atomically(folder / "figures" / f"{name}.png", png)
    for name, content in files.items():
        write_atomically(folder / name, content)
    write_atomically(folder / "summary.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")


def require_place(path: Path | None) -> None:
    """Raises unless a command can write a file, which it finds out before it computes what it would lose.

    Raises:
        OSError: If there is a folder in its place, or no folder to write it in.
    """
    if path is None:
        return
    if path.is_dir():
        raise _system_error(errno.EISDIR, path)
    if not path.parent.is_dir():
        raise _system_error(errno.ENOTDIR if path.parent.exists() else errno.ENOENT, path.parent)
    if not os.access(path.parent, os.W_OK):
        raise _system_error(errno.EACCES, path.parent)


def _system_error(number: int, path: Path) -> OSError:
    """Returns what the operating system would raise: a subclass of OSError that belongs to the number."""
    return OSError(number, os.strerror(number), str(path))


def file_name(run: Any) -> str:
    """Returns the name of a run's file: its name, with hyphens for what is special in file names."""
    return re.sub(r"[^\w.+-]+", "-", run.name) + ".json"


def save(folder: Path, run: Any, result: Any) -> None:
    """Writes the result of a run into `runs/NAME.json`, and before it the agent's files into `models/NAME/`.

    Raises:
        OSError: If a file cannot be written.
    """
    path, models = folder / "runs" / file_name(run), folder / "models" / run.name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)  # an older result must not stand for the newer agent
    for name, content in result.files.items():
        models.mkdir(parents=True, exist_ok=True)
        write_atomically(models / name, content)
    values = {name: value for name, value in asdict(result).items() if name != "files"}
    text = json.dumps({"key": run.key, "result": values}, default=np.ndarray.tolist)
    write_atomically(path, text + "\n")


def load(folder: Path, run: Any) -> Any | None:
    """Returns the result of a run; None if there is none of its settings and versions, or not whole."""
    path = folder / "runs" / file_name(run)
    if not path.exists() or not all((folder / "models" / run.name / name).is_file() for name in run.leaves):
        return None
    try:
        document = json.loads(path.read_bytes())
        if document["key"] != run.key:
            return None
        files = {name: (folder / "models" / run.name / name).read_bytes() for name in run.leaves}
        return replace(run.result_type.of_json(document["result"]), files=files)
    except (OSError, LookupError, TypeError, ValueError, RecursionError):
        say(f"{path} is damaged: its run is done again")
        return None
