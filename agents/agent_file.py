"""The files of an agent, and those that come with the package; nothing here needs torch."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from contextlib import suppress
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ncs_gym.reading import LARGEST_MODEL, read_file
from ncs_gym.validation import shown

# Files of an agent.
AGENT_FILES = ("model.zip", "agent.json")


class AgentError(ValueError):
    """A file or folder holds no agent, a damaged or altered one, or one of another environment."""


def read_files(folder: str | Path) -> dict[str, bytes]:
    """Returns the contents of an agent's files by name, given their folder or one of them.

    Raises:
        AgentError: If a file is missing, no regular file, or larger than it may be (`ncs_gym.reading`).
    """
    folder = Path(folder)
    folder = folder.parent if folder.name in AGENT_FILES else folder
    try:
        return {
            "agent.json": read_file(folder / "agent.json"),
            "model.zip": read_file(folder / "model.zip", LARGEST_MODEL),
        }
    except OSError as error:
        raise AgentError(
            f"no agent in {folder}: cannot read {Path(error.filename).name} ({error.strerror}); `ncs compare` leaves "
            "agents in OUT/models"
        ) from error


def pretrained_folder(env_id: str) -> Path:
    """Returns the folder of the small agent that comes with the package for an id; raises AgentError if it has none."""
    found = pretrained_folders()
    if env_id not in found:
        raise AgentError(f"there is no pretrained agent of {shown(env_id)}, only of {', '.join(found)}")
    return found[env_id]


def pretrained_folders() -> dict[str, Path]:
    """Returns the folders of the agents that come with the package by id."""
    root = Path(str(resources.files("agents"))) / "trained"
    return {f"ncs_gym/{file.parent.name}": file.parent for file in sorted(root.glob("*/agent.json"))}


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Returns the versions of Python and of those packages that are installed."""
    found = {"python": platform.python_version()}
    for name in packages:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
