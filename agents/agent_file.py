"""The files of an agent: `agent.json` has numbers, names and the checksum of `model.zip`, the weights."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from ncs_gym.reading import LARGEST_MODEL, json_values, read_file
from ncs_gym.validation import shown
from shields.atomic_write import write_atomically
from shields.runtime.safety_filter import LONGEST_HORIZON, MODES

# Files of an agent: no other name is read or written for one, whoever made the list of names.
AGENT_FILES = ("model.zip", "agent.json")
_FORMAT = "ncs-gym agent 3"


class AgentError(ValueError):
    """A file or folder holds no agent, a damaged or altered one, or one of another environment."""


def document_of(content: dict[str, Any]) -> bytes:
    """Returns the `agent.json` of some content."""
    return (json.dumps({"format": _FORMAT} | content, indent=1) + "\n").encode()


def require_names(names: Iterable[str]) -> None:
    """Raises unless files of these names may belong to an agent.

    Raises:
        AgentError: If a name is none of `AGENT_FILES`; it may lead out of the agent's folder.
    """
    for name in names:
        if name not in AGENT_FILES:
            raise AgentError(f"an agent has no file of the name {shown(name)}, only {' and '.join(AGENT_FILES)}")


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes the files of an agent in a folder that exists; nothing if a name is none of `AGENT_FILES` (AgentError)."""
    require_names(files)
    for name, content in files.items():
        write_atomically(folder / name, content)


def read_files(folder: str | Path) -> tuple[Path, dict[str, Any], bytes]:
    """Returns the folder of an agent, the content of its `agent.json` and its `model.zip`, whose checksum is right.

    Args:
        folder: The folder, or one of the two files in it.

    Raises:
        AgentError: If a file is missing, damaged, of another format or larger than it may be (`ncs_gym.reading`).
    """
    folder = Path(folder)
    folder = folder.parent if folder.name in AGENT_FILES else folder
    try:
        content = json_values(read_file(folder / "agent.json"))
        weights = read_file(folder / "model.zip", LARGEST_MODEL)
    except OSError as error:
        raise AgentError(
            f"no agent in {folder}: cannot read {Path(error.filename).name} ({error.strerror}); `ncs compare` leaves "
            "agents in OUT/models"
        ) from error
    except (ValueError, RecursionError) as error:
        raise AgentError(f"{folder / 'agent.json'} is damaged: it is not valid JSON") from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise AgentError(f"{folder / 'agent.json'} is not of format {_FORMAT!r}")
    if hashlib.sha256(weights).hexdigest() != content.get("sha256_of_model"):
        raise AgentError(f"{folder / 'model.zip'} is not the one that {folder / 'agent.json'} belongs to")
    return folder, content, weights


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


def shield_to_json(mode: str | None, horizon: int | None) -> dict[str, Any] | None:
    """Returns mode and horizon of a shield as JSON values; None for no shield."""
    return None if mode is None else {"mode": mode, "horizon": horizon}


def shield_from_json(content: dict[str, Any] | None) -> tuple[str | None, int | None]:
    """Returns mode and horizon of the shield that an agent was trained behind; None for no shield."""
    if content is None:
        return None, None
    mode, horizon = content["mode"], content["horizon"]
    if mode not in MODES or not (horizon is None or (type(horizon) is int and 1 <= horizon <= LONGEST_HORIZON)):
        raise AgentError("the agent is damaged: there is no shield of that mode and horizon")
    return mode, horizon
