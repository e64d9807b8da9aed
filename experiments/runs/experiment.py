"""What an experiment consists of: the control loop that its settings ask for, a verified certificate, and its runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from agents.agent_file import AGENT_FILES, pretrained_folder
from agents.hyperparams import with_changes
from agents.loop import LoopConfig
from experiments.baselines import FILTERS, tuned_training
from experiments.runs.arms import Arm
from experiments.runs.loops import other_scenarios, under
from experiments.runs.policies import PRETRAINED
from experiments.runs.provenance import versions
from experiments.runs.training_run import TrainingRun
from experiments.settings import BackendSettings, LearningSettings, settings_json
from ncs_gym.envs.env import ncs_env
from shields import Certificate, Report, certificate_for
from shields.certificate_text import size_of
from shields.verification import require_valid

# Settings that results do not depend on.
INCIDENTAL_SETTINGS = ("out", *BackendSettings.__dataclass_fields__)


def require_trainable(settings: LearningSettings, loop: LoopConfig) -> None:
    """Raises what training would raise later if agents cannot be trained with the hyperparameters given."""
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
        return certificate_for(env.plant, env.certificate_contract, safe_set)
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

    Raises:
        ValueError: If the arm or a scenario is unknown.
        AgentError: If the arm is the pretrained agent's, and the package has none for the environment.
    """
    arm, hyperparams = Arm.of(arm_name, settings.mode), settings.all_hyperparams
    if arm.is_trained and getattr(settings, "tuned_arms", False):
        own = dict(tuned_training(loop.env, arm.name))
        hyperparams = with_changes(hyperparams, own.pop("hyperparams", {}))
        if "lagrangian" in own:
            own["lagrangian"] = replace(settings.lagrangian, **own["lagrangian"])
        settings = replace(settings, **own)
    agent_files = {}
    if arm.policy == PRETRAINED:  # its checksums are verified where it acts
        folder = pretrained_folder(loop.env)
        agent_files = {name: (folder / name).read_bytes() for name in AGENT_FILES}
    training_loop, loop = arm.loops(loop, certificate, settings)
    if index == 0:  # what cannot be made is refused before anything is trained
        if arm.is_trained:
            require_trainable(settings, training_loop)
        if arm.mode in FILTERS:
            try:
                loop.vector(1).close()
            except ValueError as error:
                raise ValueError(f"arm {arm.name}: {error}") from None
    scenarios = other_scenarios(getattr(settings, "scenarios", ()))
    for scenario in scenarios:  # what cannot be simulated is refused before anything is trained
        try:
            under(scenario, loop).single().close()
        except ValueError as error:
            raise ValueError(f"--scenarios {scenario}: {error}") from None
    origin = f"synthesized for plant {certificate.fingerprint} under {certificate.contract}"
    origin += "" if certificate.polytope is None else " with a polytope"
    return TrainingRun(
        arm=arm.name,
        policy_kind=arm.policy,
        training_loop=training_loop,
        loop=loop,
        module=settings.env.rpartition(":")[0],
        seed=settings.seed,
        index=index,
        steps=settings.training_steps,
        episodes=settings.episodes,
        certificate=certificate,
        certificate_basis=origin if settings.certificate is None else "",
        scenarios=scenarios,
        algorithm=settings.algo,
        settings=hyperparams,
        grid_point=grid_point,
        agent_files=agent_files,
    )


def certificate_line(certificate: Certificate, verification: Report) -> str:
    """Returns one line about a certificate and its exact verification."""
    size = size_of(certificate)
    conditions = f"certificate: {len(verification.conditions)} conditions hold in exact arithmetic"
    return f"{conditions} ({size})" if size else conditions


def lasting_settings(settings: Any) -> dict[str, Any]:
    """Returns the settings of a command that results depend on, JSON values."""
    kept = settings_json("", settings)["settings"]
    return {name: value for name, value in kept.items() if name not in INCIDENTAL_SETTINGS}


def experiment_provenance(
    settings: LearningSettings, loop: LoopConfig, certificate: Certificate, runs: Sequence[TrainingRun]
) -> dict[str, Any]:
    """Returns what a reader needs to know where the results of a command come from, JSON values."""
    env = ncs_env(loop.single())
    channel = env.channel.description
    if env.downlink is not None:
        channel += f" Commands: {env.downlink.description}"
    return {
        "runs": {run.name: run.key for run in runs},
        "seeds": {run.index: {"training": run.training_seed, "evaluation": run.evaluation_seed} for run in runs},
        "settings": lasting_settings(settings),
        "plant": {"fingerprint": env.plant.fingerprint, "spectral_radius": env.plant.spectral_radius},
        "described": {"plant": str(env.plant), "channel": channel},
        "certificate": certificate.checksum,
        "certificate_file": certificate.document,
        "versions": versions(),
    }
