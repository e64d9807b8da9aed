"""What an experiment consists of: the control loop that its settings ask for, a verified certificate, and its runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from agents.loop import LoopConfig
from experiments.runs.arms import Arm
from experiments.runs.environments import module_and_id, registered_env
from experiments.runs.provenance import versions
from experiments.runs.scenarios import other_scenarios
from experiments.runs.synthesis_status import synthesis_status
from experiments.runs.training_run import TrainingRun
from experiments.settings import Assignments, BackendSettings, LearningSettings, changed_channel, settings_json
from ncs_gym import Channel, NCSEnv
from ncs_gym.envs.env import ncs_env
from shields import Certificate, Report
from shields.certificate_text import size_of
from shields.runtime.wrapper import certificate_for
from shields.verification import require_valid

# Settings that results do not depend on.
INCIDENTAL_SETTINGS = ("out", *BackendSettings.__dataclass_fields__)


def loop_config(
    env_id: str,
    channel: Assignments | None = None,
    *,
    noise: str = "truncated",
    mass_factor: float | None = None,
    downlink_loss: float | None = None,
) -> LoopConfig:
    """Returns the control loop of a registered environment with changes, whose keyword arguments are JSON values.

    Args:
        env_id: Id, or "module:id" if the user gave it.
        channel: Changes of the environment's own channel by name; see `changed_channel`.
        noise: "truncated", or "gaussian" for noise without a bound.
        mass_factor: Of the mass in the process, the model being what it was; None keeps the mass.
        downlink_loss: Loss probability of the environment's own downlink in place of its own; None keeps it.

    Raises:
        ValueError: If the environment is unknown or has no plant of its own, has no downlink although one is to be
            changed, or cannot have the channel or another mass.
    """
    env, kwargs = registered_env(env_id), {}
    if (changed := changed_channel(env.channel, channel or {})) is not None:
        kwargs["channel"] = asdict(changed)
    if noise != "truncated":
        kwargs["noise"] = noise
    if downlink_loss is not None:
        kwargs["downlink"] = asdict(replace(_downlink_of(env, env_id), loss=downlink_loss))
    if mass_factor is not None:
        kwargs["process"] = asdict(env.process.with_mass(mass_factor))  # pyright: ignore
    return LoopConfig(env=module_and_id(env_id)[1], kwargs=kwargs)


def require_trainable(settings: LearningSettings, loop: LoopConfig) -> None:
    """Returns if agents can be trained with the hyperparameters given; those that are not given can.

    Raises:
        ValueError: If there is no such hyperparameter, or the learning library does not take its value.
        ModuleNotFoundError: If the algorithm's package is not installed.
        OSError: If the file of hyperparameters cannot be read.
    """
    if settings.hyperparams or settings.conf_file is not None:
        from agents import training  # imports torch

        training.require_trainable(loop, settings.training_steps, settings.algo, settings.all_hyperparams)


def certificate_of(loop: LoopConfig, file: Path | None = None, safe_set: str | None = None) -> Certificate:
    """Returns a certificate for the plant of a control loop, under the contract of its channels.

    Args:
        loop: The control loop.
        file: File of the certificate, which is verified; None synthesizes one.
        safe_set: Of one that is synthesized: "polytope", "ellipsoid" or None; see `shields.synthesize`.

    Raises:
        ValueError: If the environment cannot have its keyword arguments.
        CertificateError: If a given certificate is damaged or does not verify for the plant.
        Infeasible: If no certificate is found.
    """
    env = ncs_env(loop.single())
    if file is None:
        with synthesis_status() as show:
            return certificate_for(env.plant, env.certificate_contract, show, safe_set)
    certificate = Certificate.load(file)
    require_valid(certificate, env.plant)
    return certificate


def run_of_arm(
    settings: LearningSettings,
    loop: LoopConfig,
    certificate: Certificate,
    arm_name: str,
    index: int,
    grid_point: str = "",
) -> TrainingRun:
    """Returns one training run of an arm, or the run of an arm in which nothing is trained.

    Args:
        settings: Settings of the command.
        loop: The bare control loop.
        certificate: Certificate for its plant.
        arm_name: Name of the arm.
        index: Number of the run within its arm.
        grid_point: Name of the point of a sweep's grid.

    Raises:
        ValueError: If the arm or a scenario is unknown.
    """
    arm = Arm.of(arm_name, settings.mode)
    training_loop, loop = arm.loops(loop, certificate, settings)
    origin = f"synthesized for plant {certificate.fingerprint} under {certificate.contract}"
    origin += "" if certificate.polytope is None else " with a polytope"
    return TrainingRun(
        arm=arm.name,
        policy_kind=arm.policy,
        training_loop=training_loop,
        loop=loop,
        module=module_and_id(settings.env)[0],
        seed=settings.seed,
        index=index,
        steps=settings.training_steps,
        episodes=settings.episodes,
        certificate=certificate,
        certificate_basis=origin if settings.certificate is None else "",
        scenarios=other_scenarios(settings.evaluated_under),
        algorithm=settings.algo,
        settings=settings.all_hyperparams,
        grid_point=grid_point,
    )


def certificate_line(certificate: Certificate, verification: Report) -> str:
    """Returns one line about a certificate and its exact verification."""
    size = size_of(certificate.provenance)
    conditions = f"certificate: {len(verification.conditions)} conditions hold in exact arithmetic"
    return f"{conditions} ({size})" if size else conditions


def experiment_provenance(
    command: str, settings: LearningSettings, loop: LoopConfig, certificate: Certificate, runs: Sequence[TrainingRun]
) -> dict[str, Any]:
    """Returns what a reader needs to know where the results of a command come from, JSON values."""
    content, env = settings_json(command, settings)["settings"], ncs_env(loop.single())
    channel = env.channel.description
    if env.downlink is not None:
        channel += f" Commands: {env.downlink.description}"
    return {
        "runs": {run.name: run.key for run in runs},
        "seeds": {run.index: {"training": run.training_seed, "evaluation": run.evaluation_seed} for run in runs},
        "settings": {name: value for name, value in content.items() if name not in INCIDENTAL_SETTINGS},
        "plant": {"fingerprint": env.plant.fingerprint, "spectral_radius": env.plant.spectral_radius},
        "described": {"plant": str(env.plant), "channel": channel},
        "certificate": certificate.checksum,
        "certificate_file": certificate.document,
        "versions": versions(),
    }


def _downlink_of(env: NCSEnv, env_id: str) -> Channel:
    """Returns an environment's own downlink.

    Raises:
        ValueError: If it has none.
    """
    if env.downlink is None:
        raise ValueError(f"{env_id} has an ideal downlink, which loses nothing: choose an environment with a downlink")
    return env.downlink
