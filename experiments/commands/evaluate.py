"""`ncs evaluate`: evaluates a trained agent."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any

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
from experiments.terminal import wrapped
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import counted
from shields.atomic_write import write_atomically

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
    agent, folder = agent_named(str(settings.model), env_id)
    loop = LoopConfig(env=agent.env, kwargs=agent.env_kwargs)
    if settings.between_samples is not None:
        loop = loop.with_kwargs(between_samples=settings.between_samples)
    loop = with_channel(loop, settings.channel)
    chosen = agent.shield_mode if settings.shield == "as-trained" else settings.shield
    mode = None if chosen == "none" else chosen
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
    others = {name: value for name, value in loop.kwargs.items() if name != "channel"}
    made = ", the plant of its files" if "plant" in others else ""
    made += "".join(f", {name}={value!r}" for name, value in others.items() if name != "plant")
    made += "" if loop.channel is None else f", channel={loop.channel}"
    what = f"{agent.algorithm} of {folder} in {agent.env}{made}"
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
            "model": {"folder": str(folder), "sha256": agent.checksum},
            "plant": ncs_env(loop.single()).plant.fingerprint,
            "certificate": certificate.checksum,
            "versions": versions(),
        }
        write_atomically(settings.out, json.dumps(content, indent=1) + "\n")


def _proof_text(arm: dict[str, Any]) -> str:
    """Returns after how many steps the guarantee held."""
    return f"The guarantee held after {arm['eval_proved_steps']:,} of {counted(arm['eval_steps'], 'step')}."
