"""Settings of a run in a file, from which the same run can be started again."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from experiments.errors import SettingsError
from experiments.json_values import from_json
from experiments.settings.arguments import id_alone, registration_of
from experiments.settings.learning import BackendSettings
from ncs_gym.reading import json_values, read_file
from ncs_gym.validation import reason_of, shown
from shields.atomic_write import write_atomically

FORMAT = "ncs-gym settings 1"
# Settings that results do not depend on.
INCIDENTAL_SETTINGS = ("out", *BackendSettings.__dataclass_fields__)
# Settings of one call, which a file neither keeps nor gives: files outside the output folder are the user's to name.
_OF_THE_CALL = ("config", "force", "page", "quote")
# Where runs are executed is kept in a file and not taken from it: a file of others must not connect to a cluster.
_OF_THE_MACHINE = ("engine", "ray_address", "ray_wait", "cpus_per_run", "gpus_per_run")


def settings_json(command: str, settings: Any) -> dict[str, Any]:
    """Returns a command's settings as JSON values; of "module:id" the id alone: a file imports nothing.

    Beside them stands what the environments are registered with, as far as they are.
    """
    values = json.loads(json.dumps(asdict(settings), default=str))
    ids = []
    if isinstance(values.get("env"), str):
        ids = [id_alone(values["env"])]
        values["env"] = ids[0]
    if isinstance(values.get("envs"), list):
        ids = values["envs"] = [id_alone(each) for each in values["envs"]]
    kept = {name: value for name, value in values.items() if name not in _OF_THE_CALL}
    environments = {env_id: digest for env_id in ids if (digest := registration_of(env_id))}
    return {"format": FORMAT, "command": command, "settings": kept, "environments": environments}


def lasting_settings(settings: Any) -> dict[str, Any]:
    """Returns the settings of a command that results depend on, JSON values."""
    kept = settings_json("", settings)["settings"]
    return {name: value for name, value in kept.items() if name not in INCIDENTAL_SETTINGS}


def save_settings(path: Path, command: str, settings: Any) -> None:
    """Writes a command's settings.

    Raises:
        OSError: If the file cannot be written.
    """
    write_atomically(path, json.dumps(settings_json(command, settings), indent=1) + "\n")


def config_defaults(arguments: list[str], command: str, kind: type) -> tuple[Any, list[str]]:
    """Returns the settings in the file given by `--config`, or None, and the other arguments.

    Raises:
        SettingsError: If the flag is given more than once or without a file, or the file is missing, damaged, larger
            than documents may be (`ncs_gym.reading`) or another command's, or holds a wrong value.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config", action="append", nargs="?", const="", default=[])
    found, others = parser.parse_known_args(arguments)
    if not found.config:
        return None, arguments
    if len(found.config) > 1:
        raise SettingsError(f"--config is given {len(found.config)} times")
    if not found.config[0]:
        raise SettingsError("--config needs a file")
    names_folder = any(each.partition("=")[0] == "--out" for each in others)
    return _load(Path(found.config[0]), command, kind, names_folder), others


def _load(path: Path, command: str, kind: type, names_folder: bool) -> Any:
    try:
        document = json_values(read_file(path))
    except OSError as error:
        raise SettingsError(f"cannot read settings {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"settings {path} are damaged: not valid JSON") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise SettingsError(f"{path} is not of format {FORMAT!r}")
    if document.get("command") != command or not isinstance(document.get("settings"), dict):
        other = shown(str(document.get("command")))[1:-1]
        raise SettingsError(f"{path} holds settings of ncs {other}, not of ncs {command}")
    values = {name: value for name, value in document["settings"].items() if name not in _OF_THE_MACHINE}
    envs = values.get("envs")
    for env_id in (values.get("env"), *(envs if isinstance(envs, list) else ())):
        if isinstance(env_id, str) and env_id != id_alone(env_id):
            raise SettingsError(
                f"unknown environment {shown(env_id)}: settings in a file import no module; let {path} name the id "
                "alone, and give --env module:id if you trust the module"
            )
    try:
        for name in values.keys() & set(_OF_THE_CALL):
            raise TypeError(f"{name} = {json.dumps(values[name])}")
        settings = from_json(values, kind)
        if not names_folder and not _is_near(settings.out, path):
            raise ValueError(f"out = {shown(str(settings.out))} lies neither here nor beside the file: give --out")
        return settings
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise SettingsError(f"settings {path} hold what ncs {command} does not take: {reason_of(error)}") from error


def _is_near(folder: Path, path: Path) -> bool:
    """Returns whether an output folder lies in the working folder, or is the one that the file of settings lies in."""
    place = folder.resolve()
    return place.is_relative_to(Path.cwd().resolve()) or place == path.parent.resolve()
