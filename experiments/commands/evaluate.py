"""`ncs evaluate`: evaluates a trained agent."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from agents import evaluation
from agents.agent_file import pretrained_folder
from agents.loop import LoopConfig, ShieldSettings
from experiments.analysis.episodes import arm_summary, episodes_table
from experiments.analysis.tables import summary_text
from experiments.commands import short_version
from experiments.runs.experiment import certificate_of
from experiments.runs.loops import module_and_id, registered_env, with_channel
from experiments.runs.output_folder import require_place
from experiments.runs.policies import PRETRAINED, agent_folder, certificate_file
from experiments.runs.provenance import versions
from experiments.runs.training_run import RunResult
from experiments.settings import EvaluateSettings
from experiments.settings.arguments import require_horizon
from ncs_gym.envs.env import ncs_env
from shields.atomic_write import write_atomically

if TYPE_CHECKING:
    from agents.agent import Agent

# Budget of `--smoke`.
_SMOKE = {"episodes": 5}


def evaluate(settings: EvaluateSettings) -> None:
    """Runs `ncs evaluate`."""
    settings = short_version(settings, **_SMOKE)
    require_place(settings.out)
    folder = _folder(settings)
    agent = _agent(folder, settings.env)
    loop = with_channel(LoopConfig(env=agent.env, kwargs={"channel": agent.channel}), settings.channel)
    mode = _mode(settings, agent)
    horizon = (settings.horizon or agent.horizon) if mode == "lookahead" else None
    certificate = certificate_of(loop, settings.certificate or certificate_file(folder))
    shield = None if mode is None else ShieldSettings(certificate, mode, horizon=horizon, on_unproved="ignore")
    evaluated = evaluation.evaluate(
        replace(loop, shield=shield),
        lambda observations, infos: agent.act(observations),
        settings.episodes,
        settings.seed,
        certificate.polytope or certificate.M,
    )
    shield_name = mode or "none"
    result = RunResult(shield_name, 0, 0, 0, 0, [], evaluated.episodes, evaluated.trajectory, {})
    arms = {f"shield: {shield_name}": arm_summary(episodes_table([result]), mode, fixed_policy=True)}
    print(f"{agent.algorithm} of {folder} in {agent.env}, {settings.episodes:,} episodes", end="\n\n")
    print(summary_text(arms, {}))
    if settings.out is not None:
        content = {
            "arms": arms,
            "env": agent.env,
            "channel": loop.channel and asdict(loop.channel),
            "horizon": shield and shield.horizon,
            "episodes": settings.episodes,
            "seed": settings.seed,
            "model": {"folder": str(folder), "sha256": agent.checksum},
            "plant": ncs_env(loop.single()).plant.fingerprint,
            "certificate": certificate.checksum,
            "versions": versions(),
        }
        write_atomically(settings.out, json.dumps(content, indent=1) + "\n")


def _folder(settings: EvaluateSettings) -> Path:
    """Returns the folder of the agent that is asked for."""
    if str(settings.model) != PRETRAINED:
        return agent_folder(settings.model)
    if settings.env is None:
        raise ValueError(f"{PRETRAINED} agents are of an environment each: give --env")
    return pretrained_folder(module_and_id(settings.env)[1])


def _agent(folder: Path, env_id: str | None) -> Agent:
    """Returns the agent in a folder."""
    from agents.agent import (
        Agent,  # imports torch
        is_sb3_zip,
        load_sb3_zip,
    )

    if env_id is not None:
        registered_env(env_id)
    if is_sb3_zip(folder):
        if env_id is None:
            raise ValueError(f"{folder} does not say of which environment it is: give --env")
        return load_sb3_zip(folder, module_and_id(env_id)[1])
    agent = Agent.load(folder)
    if env_id is None:
        registered_env(agent.env)
    elif module_and_id(env_id)[1] != agent.env:
        raise ValueError(f"the agent in {folder} was trained in {agent.env}, not in {env_id}")
    return agent


def _mode(settings: EvaluateSettings, agent: Agent) -> str | None:
    """Returns the mode of the shield, None for no shield; by default that of the agent's training."""
    chosen = agent.shield_mode if settings.shield == "as-trained" else settings.shield
    mode = None if chosen == "none" else chosen
    require_horizon(settings, mode)
    return mode
