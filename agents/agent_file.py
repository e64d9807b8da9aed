"""The files of an agent, and those that come with the package; nothing here needs torch."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from ncs_gym.reading import LARGEST_MODEL, read_file
from ncs_gym.validation import shown

# Files of an agent.
AGENT_FILES = ("model.zip", "agent.json")


class AgentError(ValueError):
    """A file or folder holds no agent, a damaged or altered one, or one of another environment."""


def read_files(folder: str | Path) -> dict[str, bytes]:
    """Returns the contents of an agent's files by name; what they hold is looked at by `Agent.of_files`.

    Args:
        folder: The folder, or one of the two files in it.

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
    """Returns the folder of the small agent that comes with the package.

    Args:
        env_id: Id of an environment of this package.

    Raises:
        AgentError: If the package has none for it; the message names those that it has.
    """
    found = _pretrained()
    if env_id not in found:
        raise AgentError(f"there is no pretrained agent of {shown(env_id)}, only of {', '.join(found)}")
    return found[env_id]


def has_pretrained(env_id: str) -> bool:
    """Returns whether an agent of an environment comes with the package."""
    return env_id in _pretrained()


def _pretrained() -> dict[str, Path]:
    """Returns the folders of the agents that come with the package, by the ids of their environments."""
    root = Path(str(resources.files("agents"))) / "trained"
    return {f"ncs_gym/{file.parent.name}": file.parent for file in sorted(root.glob("*/agent.json"))}
