"""`ncs evaluate`: evaluates a trained agent."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents import evaluation
from agents.loop import LoopConfig, ShieldSettings
from experiments.analysis.episodes import arm_summary
from experiments.commands import short_version
from experiments.report.text_tables import summary_text
from experiments.runs.loops import certificate_of, registered_env, with_channel
from experiments.runs.output_folder import require_place
from experiments.runs.policies import agent_named, certificate_file
from experiments.runs.provenance import versions
from experiments.runs.training_run import RunResult
from experiments.settings import EvaluateSettings
from experiments.settings.arguments import id_alone, require_horizon
from experiments.terminal import say, wrapped
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import counted
from shields.atomic_write import write_atomically

if TYPE_CHECKING:
    from agents.agent import Agent

# Budget of `--smoke`.
_SMOKE = {"episodes": 5}


def evaluate(settings: EvaluateSettings) -> None:
    """Runs `ncs evaluate`."""
    settings = short_version(settings, **_SMOKE)
    require_place(settings.out)
    env_id = None
    if settings.env is not None:
        registered_env(settings.env)
        env_id = id_alone(settings.env)
    model = settings.model
    is_of_agent = model.name == "model.zip" and model.with_name("agent.json").exists()
    is_zip = model.suffix == ".zip" and model.is_file() and not is_of_agent
    agent, folder = _of_zip(settings, env_id) if is_zip else _of_folder(settings, env_id)
    loop = LoopConfig(env=agent.env, kwargs=agent.env_kwargs)
    if settings.between_samples is not None:
        loop = loop.with_kwargs(between_samples=settings.between_samples)
    loop = with_channel(loop, settings.channel)
    chosen = agent.shield_mode if settings.shield == "as-trained" else settings.shield
    mode = None if chosen == "none" else chosen
    if settings.shield == "as-trained" and is_zip:
        say(
            f"{folder.name} does not say behind which shield and on which channel the agent was trained: no shield and "
            "the channel of the id are used; give --shield and --channel"
        )
    elif settings.shield == "as-trained" and agent.is_filtered:
        say("the agent was trained behind a filter that is no shield, which its files do not keep: none is used here")
    require_horizon(settings, mode)
    horizon = agent.horizon if mode == "lookahead" and settings.horizon is None else settings.horizon
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
    result = RunResult(shield_name, 0, 0, 0, 0, [], evaluated.episodes)
    arms = {f"shield: {shield_name}": arm_summary([result], mode, fixed_policy=True)}
    statistics = "" if settings.vec_normalize is None else f" with --vec-normalize {settings.vec_normalize}"
    others = {name: value for name, value in loop.kwargs.items() if name != "channel"}
    made = ", the plant of its files" if "plant" in others else ""
    made += "".join(f", {name}={value!r}" for name, value in others.items() if name != "plant")
    made += "" if loop.channel is None else f", channel={loop.channel}"
    what = f"{agent.algorithm} of {folder}{statistics} in {agent.env}{made}"
    print(wrapped(f"{what}, {counted(settings.episodes, 'episode')}"), end="\n\n")
    print(summary_text(arms, {}))
    if mode is not None:
        (arm,) = arms.values()
        print(wrapped(_proof_text(arm)))
    if settings.out is not None:
        content = {
            "arms": arms,
            "env": agent.env,
            "channel": loop.channel and asdict(loop.channel),
            "kwargs": others,
            "horizon": shield and shield.horizon,
            "episodes": settings.episodes,
            "seed": settings.seed,
            "model": {
                "folder": str(folder),
                "sha256": agent.checksum,
                "vec_normalize": settings.vec_normalize and str(settings.vec_normalize),
            },
            "plant": ncs_env(loop.single()).plant.fingerprint,
            "certificate": certificate.checksum,
            "versions": versions(),
        }
        write_atomically(settings.out, json.dumps(content, indent=1) + "\n")


def _of_folder(settings: EvaluateSettings, env_id: str | None) -> tuple[Agent, Path]:
    if settings.algorithm is not None or settings.vec_normalize is not None or settings.trust:
        raise ValueError(
            f"--algorithm, --vec-normalize and --trust are for zips of stable-baselines3, not for {settings.model}"
        )
    return agent_named(str(settings.model), env_id)


def _of_zip(settings: EvaluateSettings, env_id: str | None) -> tuple[Agent, Path]:
    from agents.agent import load_sb3_zip  # imports torch

    if env_id is None or settings.algorithm is None or settings.vec_normalize is None or not settings.trust:
        raise ValueError(
            f"{settings.model} needs --env, --algorithm, --vec-normalize (a file, or none) and --trust, since what is "
            "pickled in it may run code"
        )
    statistics = None if str(settings.vec_normalize) == "none" else settings.vec_normalize
    return load_sb3_zip(settings.model, env_id, settings.algorithm, statistics), settings.model


def _proof_text(arm: dict[str, Any]) -> str:
    """Returns after how many steps the guarantee held."""
    return f"The guarantee held after {arm['eval_proved_steps']:,} of {counted(arm['eval_steps'], 'step')}."
