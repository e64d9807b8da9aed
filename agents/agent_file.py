"""The files of an agent, checked, and its card: where it was trained, behind which shield, and what it did.

`agent.json` has numbers and names and the checksum of `model.zip`, the weights.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from agents.loop import ShieldSettings
from agents.results import Evaluation
from ncs_gym import Channel
from ncs_gym.validation import shown
from shields.atomic_write import write_atomically
from shields.json_documents import digest
from shields.runtime.safety_filter import LONGEST_HORIZON, MODES

# Files of an agent: no other name is read or written for one, whoever made the list of names.
AGENT_FILES = ("model.zip", "agent.json")
_FORMAT = "ncs-gym agent 2"


class AgentError(ValueError):
    """A folder holds no agent, a damaged or altered one, or one of another environment."""


def document_of(content: dict[str, Any]) -> bytes:
    """Returns the `agent.json` of some content."""
    document = {"format": _FORMAT, "sha256": digest(content), "agent": content}
    return (json.dumps(document, indent=1) + "\n").encode()


def require_names(names: Iterable[str]) -> None:
    """Returns if files of these names may belong to an agent.

    Raises:
        AgentError: If a name is none of `AGENT_FILES`; it may lead out of the agent's folder.
    """
    for name in names:
        if name not in AGENT_FILES:
            raise AgentError(f"an agent has no file of the name {shown(name)}, only {' and '.join(AGENT_FILES)}")


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes the files of an agent in a folder that exists.

    Args:
        folder: The folder.
        files: Contents by name.

    Raises:
        AgentError: If a name is none of `AGENT_FILES`; nothing is written then.
        OSError: If a file cannot be written.
    """
    require_names(files)
    for name, content in files.items():
        write_atomically(folder / name, content)


def read_files(folder: str | Path) -> tuple[Path, dict[str, Any], bytes]:
    """Returns the folder of an agent, the content of its `agent.json` and its `model.zip`, whose checksums are right.

    Args:
        folder: The folder, or one of the two files in it.

    Raises:
        AgentError: If a file is missing, damaged or of another format.
    """
    folder = Path(folder)
    folder = folder.parent if folder.name in AGENT_FILES else folder
    try:
        document, weights = json.loads((folder / "agent.json").read_bytes()), (folder / "model.zip").read_bytes()
    except OSError as error:
        raise AgentError(
            f"no agent in {folder}: cannot read {Path(error.filename).name} ({error.strerror}); `ncs compare` leaves "
            "agents in OUT/models"
        ) from error
    except (ValueError, RecursionError) as error:
        raise AgentError(f"{folder / 'agent.json'} is damaged: it is not valid JSON") from error
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise AgentError(f"{folder / 'agent.json'} is not of format {_FORMAT!r}")
    content = document.get("agent")
    if not isinstance(content, dict) or document.get("sha256") != digest(content):
        raise AgentError(f"{folder / 'agent.json'} was altered: its checksum does not match")
    if hashlib.sha256(weights).hexdigest() != content.get("sha256_of_model"):
        raise AgentError(f"{folder / 'model.zip'} was altered: its checksum does not match")
    return folder, content, weights


def pretrained_folder(env_id: str) -> Path:
    """Returns the folder of the small agent that comes with the package, with its card and its certificate.

    Args:
        env_id: Id of an environment of this package.

    Raises:
        AgentError: If the package has none for it; the message names those that it has.
    """
    root = Path(str(resources.files("agents"))) / "trained"
    found = {f"ncs_gym/{file.parent.name}": file.parent for file in sorted(root.glob("*/agent.json"))}
    if env_id not in found:
        raise AgentError(f"there is no pretrained agent of {shown(env_id)}, only of {', '.join(found)}")
    return found[env_id]


def shield_from_json(content: dict[str, Any] | None) -> tuple[str | None, int | None]:
    """Returns mode and horizon of the shield that an agent was trained behind; None each for no shield."""
    if content is None:
        return None, None
    mode, horizon = content["mode"], content["horizon"]
    if mode not in MODES or not (horizon is None or (type(horizon) is int and 1 <= horizon <= LONGEST_HORIZON)):
        raise AgentError("the agent is damaged: there is no shield of that mode and horizon")
    return mode, horizon


_PACKAGES = ("ncs-gym", "stable-baselines3", "sb3-contrib", "torch", "gymnasium", "mujoco", "numpy")
_USE = """## Use

The weights are in `model.zip`, everything else in `agent.json`. Nothing is unpickled. Checksums find damage, not
forgery.

```python
from agents import Agent, LoopConfig{imports}

agent = Agent.load(".")
loop = LoopConfig(env=agent.env, kwargs={{"channel": agent.channel}}{shield})
```
"""


def card_text(
    *,
    algorithm: str,
    hyperparams: Mapping[str, Any],
    env: str,
    channel: Channel | None,
    checksum: str,
    shield: ShieldSettings | None,
    evaluation: Evaluation | None,
) -> str:
    """Returns the card of an agent, in Markdown.

    Args:
        algorithm: Name of the algorithm.
        hyperparams: Hyperparameters the agent was trained with.
        env: Id of the environment the agent was trained in.
        channel: Channel the agent was trained with; None for that of the id.
        checksum: SHA-256 of the weights.
        shield: The shield that the agent is meant to act behind; None for none.
        evaluation: Episodes of the agent in that loop; None leaves the figures out.
    """
    plant = getattr(gym.make(env).unwrapped, "plant", None)
    rows = {
        "environment": f"`{env}`",
        "plant": "none" if plant is None else f"fingerprint `{plant.fingerprint}`",
        "channel": _channel(env, channel),
        "shield": _shield_text(shield),
        "hyperparameters": ", ".join(f"{name}={value!r}" for name, value in hyperparams.items()),
        "SHA-256 of the weights": f"`{checksum}`",
        "saved with": _versions(),
    }
    table = [f"| {name} | {value} |" for name, value in rows.items()]
    parts = [f"# {algorithm} in {env}\n", "| | |", "|---|---|", *table, ""]
    if shield is not None:
        parts += ["## Certificate", "", "```", str(shield.certificate), "```", ""]
        parts += [f"`certificate.json`, SHA-256 `{shield.certificate.checksum}`; `ncs verify certificate.json`", ""]
    if evaluation is not None:
        parts += ["## Evaluation", "", *_figures(evaluation), ""]
    known = "" if shield is None else f', shield=ShieldSettings(Certificate.load("certificate.json"), "{shield.mode}"'
    if shield is not None:
        known += ")" if shield.horizon is None else f", horizon={shield.horizon})"
    imports = "" if shield is None else ", ShieldSettings\nfrom shields import Certificate"
    return "\n".join([*parts, _USE.format(imports=imports, shield=known)])


def _channel(env: str, channel: Channel | None) -> str:
    """Returns the channel in words of Python; that of the id where the agent has none of its own."""
    own: Any = channel or getattr(gym.make(env).unwrapped, "channel", None)
    return f"`{own}`" + ("" if channel else ", that of the id")


def _versions() -> str:
    """Returns the versions of Python and of the packages that an agent is made of."""
    found = [f"Python {platform.python_version()}"]
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            found.append(f"{name} {version(name)}")
    return ", ".join(found)


def _figures(evaluation: Evaluation) -> list[str]:
    episodes = evaluation.episodes
    steps = sum(episode.steps for episode in episodes)
    violating = sum(episode.violation_steps > 0 for episode in episodes)
    returns = [episode.episode_return for episode in episodes]
    interventions = sum(episode.interventions for episode in episodes)
    return [
        f"- mean return: {np.mean(returns):.4g}, of {len(episodes)} episodes and {steps} steps",
        f"- episodes in which the true state violated the safe box: {violating} of {len(episodes)}",
        f"- violating steps: {sum(episode.violation_steps for episode in episodes)} of {steps}",
        f"- interventions of the shield: {interventions} of {steps} steps",
        f"- episodes in which the guarantee held throughout: {sum(each.guaranteed for each in episodes)}",
    ]


def _shield_text(shield: ShieldSettings | None) -> str:
    if shield is None:
        return "none"
    horizon = "" if shield.horizon is None else f", plans of at most {shield.horizon} steps"
    return f'mode "{shield.mode}"{horizon}, penalty {shield.penalty:g} per intervention'
