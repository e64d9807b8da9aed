"""The card of a shared agent: where it was trained, behind which shield, and what it did in an evaluation."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import gymnasium as gym
import numpy as np

from agents.loop import ShieldSettings
from agents.results import Evaluation
from ncs_gym import Channel

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
