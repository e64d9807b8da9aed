"""The output folder of a command: its own for as long as it runs, and finished results in it are not replaced.

It may have been made by somebody else. Nothing in it may lead elsewhere, so that writing to it writes nowhere else.
"""

from __future__ import annotations

import errno
import json
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

from filelock import FileLock, Timeout

from experiments.errors import FolderInUseError, OtherResultsError, ResultsError
from experiments.json_values import flat
from experiments.settings import INCIDENTAL_SETTINGS, save_settings, settings_json
from experiments.settings.settings_file import FORMAT as SETTINGS_FORMAT
from ncs_gym.reading import json_values, read_file
from shields.atomic_write import write_atomically

# Files by which a folder is known to hold something finished.
_FINISHED = ("summary.json", "runs/*.json")
_FINISHED_PARTS = {"train": ("tensorboard/*/checkpoint/agent.json",)}
# Settings that results do not depend on; what "smoke" changes is compared by itself.
_IGNORED = {*INCIDENTAL_SETTINGS, "smoke"}
# Settings that may grow in the same folder, because the results that are there become part of the larger ones.
_GROWING = {
    "compare": ("seeds", "arms", "baselines"),
    "sweep": ("seeds", "arms", "losses", "delays", "quantization_steps", "burst_lengths", "downlink_losses"),
    "train": ("steps",),
}
# Whoever holds the lock of this file has the folder. It is the operating system's: it ends with the process.
_LOCK = ".lock"
# What the operating system says where there are no locks.
_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)
# What stands for a finished experiment, and what is drawn and listed of it.
_FIGURES = ("scatter", "training", "episode", "phase", "violations", "return", "interventions", "states", "inputs")
_MADE_OF_RESULTS = ("summary.json", "report.html", "episodes.parquet", "training.parquet")
_MADE_OF_RESULTS += tuple(f"figures/{name}.png" for name in _FIGURES)
# Differences that a message lists, and characters of each value.
_MOST_LISTED, _MOST_CHARACTERS = 3, 40


@contextmanager
def claim_folder(command: str, settings: Any) -> Iterator[None]:
    """Creates the output folder of a command and writes `settings.json` in it; no other command has it meanwhile.

    An earlier summary, tables, figures and report, which belong together, are removed; files of other names stay. Where
    what follows is refused (ValueError, OSError) before anything was computed, the folder is left as it was.

    A folder with finished results is taken only if they have the same settings, apart from those that change no result,
    or if the new ones contain them: more seeds or arms, a larger grid of `ncs sweep`, more steps of
    `ncs train`.

    Args:
        command: Name of the command.
        settings: Its complete settings; with `force` the folder is taken in any case.

    Raises:
        FolderInUseError: If another command has the folder.
        OtherResultsError: If the folder holds finished results of other settings, or of settings that cannot be read,
            or a file `settings.json` of something else.
        ResultsError: If something in the folder is a link, or neither a file nor a folder.
        OSError: If the folder cannot be written.
    """
    folder: Path = settings.out
    if folder.is_dir():
        _require_own_entries(folder)
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _locked(folder), _settings_kept(folder, command, settings):
            yield
    finally:
        if is_new:
            with suppress(OSError):  # as a rule there is something in it
                folder.rmdir()


@contextmanager
def _settings_kept(folder: Path, command: str, settings: Any) -> Iterator[None]:
    """Writes `settings.json`, and removes it again if what follows is refused before anything was computed."""
    file = folder / "settings.json"
    before = {*folder.rglob("*")}
    _take(folder, command, settings)
    try:
        yield
    except (ValueError, OSError):
        new = {*folder.rglob("*")} - before
        if file in new and not any(entry.is_file() for entry in new - {file}):
            file.unlink()
            for empty in sorted(new - {file}, reverse=True):  # what is in a folder comes before it
                empty.rmdir()
        raise


def _take(folder: Path, command: str, settings: Any) -> None:
    """Writes `settings.json` in a folder that is locked, and removes what earlier results were made into."""
    patterns = (*_FINISHED, *_FINISHED_PARTS.get(command, ()))
    if not settings.force and any(file for pattern in patterns for file in folder.glob(pattern)):
        _require_same(folder, command, settings)
    if not settings.force:
        _require_own_settings(folder / "settings.json")
    save_settings(folder / "settings.json", command, settings)
    for name in _MADE_OF_RESULTS:
        (folder / name).unlink(missing_ok=True)


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


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Has a folder for this process alone; where the file system knows no locks, a warning says that it has not."""
    lock = FileLock(folder / _LOCK, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise FolderInUseError(f"another command is writing to {folder}: wait for it, or give another --out") from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise _system_error(error.errno or errno.EIO, folder) from error
        warnings.warn(f"the file system of {folder} has no locks: start no second command in it", stacklevel=1)
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes no file that is open: there it stays
            (folder / _LOCK).unlink()  # while the lock is held: whoever waits for this file finds that it has gone
        lock.release()


def _require_own_entries(folder: Path) -> None:
    """Raises ResultsError unless everything below a folder is a file or a folder that lies there itself."""
    advice, place = "remove it, or give another --out", os.path.realpath(folder)
    for entry in os.scandir(folder):
        path = Path(entry)
        if entry.is_symlink() or os.path.realpath(path) != os.path.join(place, entry.name):
            raise ResultsError(f"{path} is a link, and what is written there would be written elsewhere: {advice}")
        if entry.is_dir():
            _require_own_entries(path)
        elif not entry.is_file():
            raise ResultsError(f"{path} is neither a file nor a folder: {advice}")


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


def _require_own_settings(path: Path) -> None:
    """Raises OtherResultsError if there is a file in the place of settings that holds something else."""
    if not path.exists():
        return
    try:
        is_own = json_values(read_file(path))["format"] == SETTINGS_FORMAT
    except (ValueError, KeyError, TypeError, RecursionError):
        is_own = False
    if not is_own:
        raise OtherResultsError(f"{path} is none of ours: give another --out, or --force to replace it")


def _require_same(folder: Path, command: str, settings: Any) -> None:
    """Raises OtherResultsError if the results in a folder are not those of a command with these settings."""
    advice = "give another --out, or --force to replace them"
    try:
        document = json_values(read_file(folder / "settings.json"))
        kept_command, kept, registered = document["command"], document["settings"], document.get("environments", {})
        if not (isinstance(kept, dict) and isinstance(registered, dict)):
            raise TypeError("settings")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise OtherResultsError(
            f"{folder} holds finished results, and no settings.json that says of what: {advice}"
        ) from error
    if kept_command != command:
        raise OtherResultsError(f"{folder} holds finished results of ncs {kept_command}: {advice}")
    defaults, own = settings_json(command, type(settings)())["settings"], settings_json(command, settings)
    before, now = (
        flat({name: value for name, value in each.items() if name not in _IGNORED})
        for each in (defaults | kept, own["settings"])
    )
    growing = _GROWING.get(command, ())
    others = [
        f"{name} {_shown(before.get(name))}, now {_shown(now.get(name))}"
        for name in before | now
        if before.get(name) != now.get(name) and not (name in growing and _contains(now.get(name), before.get(name)))
    ]
    changed = [env_id for env_id, digest in own["environments"].items() if registered.get(env_id, digest) != digest]
    others += [f"{env_id}, which is registered otherwise now" for env_id in changed]
    if others:
        listed = "; ".join([*others[:_MOST_LISTED], *(["..."] if len(others) > _MOST_LISTED else [])])
        raise OtherResultsError(f"{folder} holds finished results of other settings ({listed}): {advice}")


def _contains(now: Any, before: Any) -> bool:
    """Returns whether a list has all values of an earlier, not empty one, or a number is at least the earlier."""
    if isinstance(before, list) and isinstance(now, list):
        return bool(before) and all(value in now for value in before)
    numbers = type(before) in (int, float) and type(now) in (int, float)
    return numbers and now >= before


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= _MOST_CHARACTERS else f"{text[: _MOST_CHARACTERS - 3]}..."
