"""The card of an agent: what people read beside the files of one that is shared."""

from __future__ import annotations

import platform
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np

from agents.loop import LoopConfig, ShieldSettings
from agents.results import Evaluation
from ncs_gym.validation import counted

if TYPE_CHECKING:
    from agents.agent import Agent

_PACKAGES = ("ncs-gym", "stable-baselines3", "sb3-contrib", "torch", "gymnasium", "mujoco", "numpy")
_USE = """## Use

The weights are in `model.zip`, everything else in `agent.json`. Nothing is unpickled. Checksums find damage, not
forgery.

```python
from agents import Agent, LoopConfig{imports}

agent = Agent.load(".")
loop = LoopConfig(
    env=agent.env,
    kwargs=agent.env_kwargs,{shield}
)
```
"""


def agent_card(agent: Agent, shield: ShieldSettings | None, evaluation: Evaluation | None) -> str:
    """Returns the card of an agent, in Markdown.

    Args:
        agent: The agent.
        shield: The shield that it is meant to act behind; None for none.
        evaluation: Episodes whose figures the card gives; None leaves them out.
    """
    rows = _loop_rows(LoopConfig(env=agent.env, kwargs=agent.env_kwargs, shield=shield))
    table = rows | {
        "channel": rows["channel"] + ("" if agent.channel else ", that of the id"),
        "shield": "none" if shield is None else f"{rows['shield']}, penalty {shield.penalty:g} per intervention",
        "filter": "one that these files do not keep" if agent.is_filtered else "",
        "hyperparameters": ", ".join(f"{name}={value!r}" for name, value in agent.hyperparams.items()),
        "residual": _residual_text(agent),
        "SHA-256 of the weights": f"`{agent.checksum}`",
        "saved with": _versions(),
    }
    lines = [f"| {name} | {value} |" for name, value in table.items() if value]
    parts = [f"# {agent.algorithm} in {agent.env}\n", "| | |", "|---|---|", *lines, ""]
    if shield is not None:
        parts += ["## Certificate", "", "```", str(shield.certificate), "```", ""]
        is_own = "plant" in agent.kwargs or not agent.env.startswith("ncs_gym/")
        check = "shields.verify(loop.shield.certificate, loop.single().unwrapped.plant)"
        check = check if is_own else "ncs verify certificate.json"
        parts += [f"`certificate.json`, SHA-256 `{shield.certificate.checksum}`; `{check}`", ""]
    if evaluation is not None:
        parts += ["## Evaluation", "", *_played_otherwise(agent, shield, evaluation.loop), *_figures(evaluation), ""]
    known = ""
    if shield is not None:
        horizon = "" if shield.horizon is None else f", horizon={shield.horizon}"
        known = f'\n    shield=ShieldSettings(Certificate.load("certificate.json"), "{shield.mode}"{horizon}),'
    imports = "" if shield is None else ", ShieldSettings\nfrom shields import Certificate"
    return "\n".join([*parts, _USE.format(imports=imports, shield=known)])


def _loop_rows(loop: LoopConfig) -> dict[str, str]:
    """Returns what a control loop is, in words: environment, plant, channel, other settings and shield."""
    env, kwargs, shield = gym.make(loop.env, **loop.kwargs).unwrapped, loop.other_kwargs, loop.shield
    plant = getattr(env, "plant", None)
    kept = ", in `agent.json`" if "plant" in kwargs else ""
    others = [f"{name}={value!r}" for name, value in kwargs.items() if name != "plant"]
    mode = "none"
    if shield is not None:
        mode = f'mode "{shield.mode}"'
        mode += "" if shield.horizon is None else f", plans of at most {counted(shield.horizon, 'step')}"
    return {
        "environment": f"`{loop.env}`",
        "plant": "none" if plant is None else f"fingerprint `{plant.fingerprint}`{kept}",
        "channel": f"`{getattr(env, 'channel', None)}`",
        "other settings": ", ".join(others) or "those of the id",
        "shield": mode,
    }


def _played_otherwise(agent: Agent, shield: ShieldSettings | None, loop: LoopConfig) -> list[str]:
    """Returns the line that says in what the loop of an evaluation differs from the rest of the card, if it does."""
    here = _loop_rows(LoopConfig(env=agent.env, kwargs=agent.env_kwargs, shield=shield))
    there = _loop_rows(loop)
    differing = [f"{name} {value}" for name, value in there.items() if value != here[name]]
    if shield is not None and loop.shield is not None and shield.certificate != loop.shield.certificate:
        differing.append(f"the certificate with SHA-256 `{loop.shield.certificate.checksum}`")
    if (loop.filter is not None) != agent.is_filtered:
        differing.append("no filter" if loop.filter is None else "a filter that the agent was not trained behind")
    return [f"- **not played as this card says**, but with: {'; '.join(differing)}"] if differing else []


def _versions() -> str:
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
    count = len(episodes)
    return [
        f"- mean return: {np.mean(returns):.4g}, of {counted(count, 'episode')} and {counted(steps, 'step')}",
        f"- episodes in which the true state violated the safe box: {violating:,} of {count:,}",
        f"- violating steps: {sum(episode.violation_steps for episode in episodes):,} of {steps:,}",
        f"- steps in which the shield, or another filter, intervened: {interventions:,} of {counted(steps, 'step')}",
        f"- episodes in which the guarantee held throughout: {sum(each.guaranteed for each in episodes):,}",
    ]


def _residual_text(agent: Agent) -> str:
    if (base := agent.base_policy) is None:
        return ""
    offset = f" + {base.offset.tolist()}" if base.offset.any() else ""
    return f"`Agent` adds {base.gain.tolist()} x_hat{offset} [actions]; the weights alone are a part of the policy"
