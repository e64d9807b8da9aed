"""`ncs evaluate`: evaluates a trained agent."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import tyro

from agents import evaluation
from agents.loop import LoopConfig, ShieldSettings
from experiments.analysis.episodes import arm_summary
from experiments.report import summary_text
from experiments.runs.loops import certificate_of, registered_env, with_channel
from experiments.runs.output_folder import require_place, write_json
from experiments.runs.policies import agent_named, certificate_file
from experiments.runs.provenance import versions
from experiments.runs.training_run import RunResult
from experiments.settings import Assignments, id_alone, require_horizon, require_limits
from experiments.terminal import wrapped
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import counted
from shields.runtime.safety_filter import Mode


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings:
    """Evaluates a trained agent, behind a shield or not, on any channel.

    Attributes:
        model: Folder of a trained agent, such as models/shielded-0 in the output of `ncs compare` and `ncs train`; or
            "pretrained", for the agent of --env that comes with the package.
        env: Id of the environment the agent was trained in, or module:id.
        shield: Mode of the shield, by default that of the agent's training; "none" for no shield; "monitor" changes
            nothing and counts what it would have done.
        horizon: Longest plan of mode "lookahead" [steps]; by default that of the agent's training, otherwise 6.
        episodes: Number of evaluation episodes.
        seed: Seed of the episodes.
        certificate: Certificate file to use instead of that of the training, or of synthesizing one.
        channel: Changes of the channel that the agent was trained with, by the names that `ncs compare` lists.
        out: File for the summary (JSON).
    """

    model: tyro.conf.Positional[Path]
    env: str | None = None
    shield: Literal["as-trained", "none", Mode] = "as-trained"
    horizon: int | None = None
    episodes: int = 200
    seed: int = 0
    certificate: Path | None = None
    channel: Assignments = field(default_factory=dict)
    out: Path | None = None

    def __post_init__(self) -> None:
        require_limits(self, episodes=1, seed=0)
        if self.shield != "as-trained":  # otherwise the agent knows
            require_horizon(self, self.shield)


def evaluate(settings: EvaluateSettings) -> None:
    """Runs `ncs evaluate`."""
    require_place(settings.out)
    if settings.env is not None:
        registered_env(settings.env)
    agent, folder = agent_named(str(settings.model), settings.env and id_alone(settings.env))
    loop = LoopConfig(env=agent.env, kwargs=agent.env_kwargs)
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
        certificate.safe_set,
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
        held = f"{arm['eval_proved_steps']:,} of {counted(arm['eval_steps'], 'step')}"
        print(wrapped(f"The guarantee held after {held}."))
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
    write_json(settings.out, content)
