"""What an experiment takes place in: an environment, its channel and a verified certificate."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from agents.control_loop import ControlLoop
from experiments.runs.arms import Arm
from experiments.runs.environments import module_and_id, registered_env
from experiments.runs.evaluation_conditions import other_conditions
from experiments.runs.provenance import versions
from experiments.runs.synthesis_status import synthesis_status
from experiments.runs.training_run import TrainingRun
from experiments.settings import BackendSettings, ChannelSettings, LearningSettings, settings_json
from ncs_gym import Channel, LinearPlant, NCSEnv
from ncs_gym.envs.env import ncs_env
from shields import Certificate, Report, verify
from shields.certificate_text import size_of
from shields.runtime.wrapper import certificate_for
from shields.verification import require_valid

# Settings that results do not depend on.
INCIDENTAL_SETTINGS = ("out", *BackendSettings.__dataclass_fields__)


@dataclass(frozen=True, eq=False)
class ExperimentSetup:
    """The environment of an experiment and its certificate.

    Attributes:
        env: Id of a registered environment.
        channel: Channel that replaces the environment's own; None keeps it.
        plant: Plant of the environment.
        certificate: Certificate for the plant, under the environment's channel contract.
        verification: Exact verification of the certificate.
        module: Module of the user's that registers the environment; empty for one of this package.
        noise: "truncated", or "gaussian" for noise without a bound.
        process: Fields of the process that replace the environment's own, JSON values; None keeps it.
        downlink: Channel that replaces the environment's own downlink; None keeps it.
        certificate_basis: What the certificate was synthesized from, in words; empty for one that was given.
    """

    env: str
    channel: Channel | None
    plant: LinearPlant
    certificate: Certificate
    verification: Report
    module: str = ""
    noise: str = "truncated"
    process: dict[str, Any] | None = None
    downlink: Channel | None = None
    certificate_basis: str = ""

    @classmethod
    def of(
        cls,
        env_id: str,
        channel: ChannelSettings | Channel | None,
        certificate_file: Path | None = None,
        noise: str = "truncated",
        mass_factor: float | None = None,
        downlink_loss: float | None = None,
    ) -> ExperimentSetup:
        """Returns the setup of a registered environment, with another channel or with changes of its own channel.

        Args:
            env_id: Id, or "module:id" if the user gave it.
            channel: Replaces or changes the environment's own channel; None keeps it.
            certificate_file: File of the certificate; by default one is synthesized.
            noise: "truncated", or "gaussian" for noise without a bound.
            mass_factor: Of the mass in the process, the model being what it was; None keeps the mass.
            downlink_loss: Loss probability of the environment's own downlink in place of its own; None keeps it.

        Raises:
            ValueError: If the environment is unknown or has no plant of its own, has no downlink although one is to be
                changed, or cannot have the channel, the noise or another mass.
            CertificateError: If a given certificate is damaged or does not verify for the plant.
            Infeasible: If no certificate is found.
        """
        own, (module, name) = registered_env(env_id), module_and_id(env_id)
        if isinstance(channel, ChannelSettings):
            channel = channel.applied_to(own.channel)
        downlink = None if downlink_loss is None else replace(_downlink_of(own, env_id), loss=downlink_loss)
        loop = ControlLoop(env=name, channel=channel, downlink=downlink, noise=noise)
        changed = channel is not None or downlink is not None or noise != "truncated"
        env = ncs_env(loop.single()) if changed else own
        if certificate_file is None:
            with synthesis_status() as show:
                certificate = certificate_for(env.plant, env.certificate_contract, show)
            basis = f"synthesized for plant {env.plant.fingerprint} under {env.certificate_contract}"
        else:
            certificate = Certificate.load(certificate_file)
            require_valid(certificate, env.plant)
            basis = ""
        process = None if mass_factor is None else asdict(env.process.with_mass(mass_factor))  # pyright: ignore
        verification = verify(certificate, env.plant)
        return cls(name, channel, env.plant, certificate, verification, module, noise, process, downlink, basis)

    @property
    def title(self) -> str:
        """One line about the certificate."""
        size = size_of(self.certificate.provenance)
        conditions = f"certificate: {len(self.verification.conditions)} conditions hold in exact arithmetic"
        return f"{conditions} ({size})" if size else conditions

    @property
    def described(self) -> dict[str, str]:
        """The plant with its bounds, and the channels that are in effect, in words."""
        own = registered_env(self.env)
        text = (own.channel if self.channel is None else self.channel).description
        if own.downlink is not None:
            text += f" Commands: {(self.downlink or own.downlink).description}"
        return {"plant": str(self.plant), "channel": text}

    def training_run(self, settings: LearningSettings, arm_name: str, index: int, grid_point: str = "") -> TrainingRun:
        """Returns one training run of an arm, or the run of an arm in which nothing is trained.

        Raises:
            ValueError: If the arm or a condition is unknown.
        """
        arm = Arm.of(arm_name, settings.mode)
        price = settings.violation_penalty if arm.violation_weight is None else arm.violation_weight
        fixed_price = arm.penalizes_violations and not arm.adapts_penalty
        return TrainingRun(
            arm=arm.name,
            policy_kind=arm.policy,
            env=self.env,
            module=self.module,
            channel=self.channel,
            downlink=self.downlink,
            noise=self.noise,
            process=self.process,
            seed=settings.seed,
            index=index,
            steps=settings.training_steps,
            episodes=settings.episodes,
            certificate=self.certificate,
            certificate_basis=self.certificate_basis,
            mode=arm.mode,
            horizon=settings.horizon if arm.mode in ("lookahead", "trusting:lookahead") else None,
            filters_training=arm.filters_training,
            intervention_penalty=settings.intervention_penalty if arm.penalizes_interventions else 0.0,
            violation_penalty=price if fixed_price else 0.0,
            lagrangian=settings.lagrangian if arm.adapts_penalty else None,
            is_residual=arm.is_residual,
            conditions=other_conditions(settings.evaluated_under),
            algorithm=settings.algo,
            settings=settings.agent,
            grid_point=grid_point,
        )

    def provenance(self, command: str, settings: LearningSettings) -> dict[str, Any]:
        """Returns what a reader needs to know where the results of a command come from, JSON values."""
        content = settings_json(command, settings)["settings"]
        return {
            "settings": {name: value for name, value in content.items() if name not in INCIDENTAL_SETTINGS},
            "plant": {"fingerprint": self.plant.fingerprint, "spectral_radius": self.plant.spectral_radius},
            "described": self.described,
            "certificate": self.certificate.checksum,
            "certificate_file": self.certificate.document,
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
