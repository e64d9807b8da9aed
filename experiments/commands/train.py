"""One agent: train it, or evaluate one that is there."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from agents.control_loop import ControlLoop, Shielding
from agents.evaluation import evaluate
from experiments.analysis.summary import summarize_arm, table_text
from experiments.backends.execution import results_of
from experiments.commands.compare import prepare, provenance, unit_of
from experiments.runs.arms import arm_of
from experiments.runs.experiment_setup import world_of
from experiments.runs.provenance import versions
from experiments.runs.training_run import UnitResult
from experiments.settings.backend import EngineSettings
from experiments.settings.channel import channel_of
from experiments.settings.learning import EvaluateSettings, TrainSettings
from experiments.settings.settings_file import save_settings
from ncs_gym.envs.env import ncs_env
from shields.atomic_write import write_atomically


def train_agent(settings: TrainSettings) -> None:
    """Runs `ncs train`.

    Raises:
        ValueError: If a setting is out of range or a stored result is damaged.
        OSError: If the output folder cannot be written.
        CertificateError: If a given certificate does not verify.
        Infeasible: If no certificate is found.
        RunError: If the run fails.
    """
    arm_of(settings.arm, settings.mode)
    world = world_of(settings.env, settings.channel, settings.certificate)
    prepare(settings.out)
    save_settings(settings.out / "settings.json", "train", settings)
    unit = unit_of(settings, world, settings.arm, 0)
    results = results_of([unit], settings.out, EngineSettings(jobs=1))
    summary = {settings.arm: _described(results, unit.mode)}
    world.certificate.save(settings.out / "certificate.json")
    content = {"arms": summary} | provenance("train", settings, world)
    write_atomically(settings.out / "summary.json", json.dumps(content, indent=1) + "\n")
    print(table_text(summary, {}), f"agent: {settings.out / 'models' / unit.name}", sep="\n")


def evaluate_agent(settings: EvaluateSettings) -> None:
    """Runs `ncs evaluate`.

    Raises:
        AgentError: If the agent's files are missing, damaged or of another environment.
        ValueError: If a setting is out of range.
        CertificateError: If a given certificate does not verify.
        Infeasible: If no certificate is found.
        OSError: If the summary cannot be written.
    """
    from agents.agent import Agent  # takes torch, which `train_agent` leaves to its workers

    agent = Agent.load(settings.model)
    own = ncs_env(ControlLoop(env=agent.env, channel=agent.channel).single()).channel
    channel = channel_of(settings.channel, own) or agent.channel
    world = world_of(agent.env, channel, settings.certificate)
    mode = None if settings.shield == "none" else settings.shield
    loop = ControlLoop(
        env=agent.env, channel=channel, shielding=None if mode is None else Shielding(world.certificate, mode)
    )
    played = evaluate(
        loop, lambda observations, infos: agent.act(observations), settings.episodes, settings.seed, world.certificate.M
    )
    result = UnitResult(settings.shield, 0, 0, 0, 0, [], played.episodes, played.trajectory, {})
    summary = {f"shield: {settings.shield}": _described([result], mode)}
    print(f"{agent.algorithm} of {settings.model} in {agent.env}\n\n{table_text(summary, {})}")
    if settings.out is not None:
        content = {
            "arms": summary,
            "env": agent.env,
            "channel": asdict(channel) if channel else None,
            "episodes": settings.episodes,
            "seed": settings.seed,
            "model": {"folder": str(settings.model), "sha256": agent.checksum},
            "plant": world.plant.fingerprint,
            "certificate": world.certificate.checksum,
            "versions": versions(),
        }
        write_atomically(settings.out, json.dumps(content, indent=1) + "\n")


def _described(results: list[UnitResult], mode: str | None) -> dict[str, Any]:
    """Returns the summary of one arm; its interval is over the episodes of one policy."""
    described = {"mode": mode, "shielded": mode not in (None, "monitor")}
    return described | summarize_arm(results, fixed_policy=True)
