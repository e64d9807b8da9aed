"""`ncs evaluate`: evaluates a trained agent."""

from __future__ import annotations

import json
from dataclasses import asdict

from agents import evaluation
from agents.control_loop import ControlLoop, ShieldSettings
from experiments.analysis.arm_table import summary_text
from experiments.analysis.summary import arm_summary
from experiments.runs import ExperimentSetup, RunResult, versions
from experiments.runs.environments import module_and_id, registered_env
from experiments.settings import EvaluateSettings
from ncs_gym.envs.env import ncs_env
from shields.atomic_write import write_atomically


def evaluate(settings: EvaluateSettings) -> None:
    """Runs `ncs evaluate`.

    Raises:
        AgentError: If the agent's files are missing, damaged or of another environment.
        ValueError: If a setting is out of range, or the agent is of another environment.
        CertificateError: If a given certificate does not verify.
        Infeasible: If no certificate is found.
        OSError: If the summary cannot be written.
    """
    from agents.agent import Agent  # imports torch

    if settings.env is not None:
        registered_env(settings.env)
    agent = Agent.load(settings.model)
    env_id = settings.env or agent.env
    if module_and_id(env_id)[1] != agent.env:
        raise ValueError(f"the agent in {settings.model} was trained in {agent.env}, not in {env_id}")
    own = ncs_env(ControlLoop(env=agent.env, channel=agent.channel).single()).channel
    channel = settings.channel.applied_to(own) or agent.channel
    setup = ExperimentSetup.of(env_id, channel, settings.certificate)
    mode = None if settings.shield == "none" else settings.shield
    horizon = (settings.horizon or agent.horizon) if mode == "lookahead" else None
    shield = None if mode is None else ShieldSettings(setup.certificate, mode, horizon=horizon)
    evaluated = evaluation.evaluate(
        ControlLoop(env=agent.env, channel=channel, shield=shield),
        lambda observations, infos: agent.act(observations),
        settings.episodes,
        settings.seed,
        setup.certificate.M,
    )
    result = RunResult(settings.shield, 0, 0, 0, 0, [], evaluated.episodes, evaluated.trajectory, {})
    arms = {f"shield: {settings.shield}": arm_summary([result], mode, fixed_policy=True)}
    print(f"{agent.algorithm} of {settings.model} in {agent.env}, {settings.episodes:,} episodes", end="\n\n")
    print(summary_text(arms, {}))
    if settings.out is not None:
        content = {
            "arms": arms,
            "env": agent.env,
            "channel": asdict(channel) if channel else None,
            "horizon": shield and shield.horizon,
            "episodes": settings.episodes,
            "seed": settings.seed,
            "model": {"folder": str(settings.model), "sha256": agent.checksum},
            "plant": setup.plant.fingerprint,
            "certificate": setup.certificate.checksum,
            "versions": versions(),
        }
        write_atomically(settings.out, json.dumps(content, indent=1) + "\n")
