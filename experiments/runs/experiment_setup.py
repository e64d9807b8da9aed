"""An environment with its channel and a verified certificate: what an experiment plays in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from experiments.commands.synthesize import plant_of
from experiments.settings.channel import ChannelSettings, channel_of
from ncs_gym import Channel, LinearPlant
from ncs_gym.envs.env import ncs_env
from shields import Certificate, Report, verify
from shields.runtime.wrapper import certificate_for
from shields.verification.verify import require_valid


@dataclass(frozen=True, eq=False)
class World:
    """Where an experiment takes place.

    Attributes:
        env: A registered id.
        channel: In place of the environment's own; None for that.
        plant: The environment's.
        certificate: For the plant, under the environment's contract.
        verification: Of the certificate, in exact arithmetic.
    """

    env: str
    channel: Channel | None
    plant: LinearPlant
    certificate: Certificate
    verification: Report

    @property
    def title(self) -> str:
        """One line about the certificate."""
        volume = self.certificate.provenance.get("volume_of_box_ellipsoid")
        size = f" ({volume:.2%} of the largest ellipsoid in the safe box)" if isinstance(volume, float) else ""
        return f"certificate: {len(self.verification.conditions)} conditions hold in exact arithmetic{size}"


def world_of(env_id: str, channel: ChannelSettings | Channel | None, certificate_file: Path | None = None) -> World:
    """Returns the world of a registered environment, with another channel or some changes of its own.

    Raises:
        ValueError: If the id is not one of ours that has a plant of its own, or the channel is none it can have.
        CertificateError: If a given certificate is damaged or does not verify for the plant.
        Infeasible: If no certificate is found.
    """
    plant_of(env_id)
    if isinstance(channel, ChannelSettings):
        channel = channel_of(channel, ncs_env(gym.make(env_id)).channel)
    changed: dict[str, Any] = {} if channel is None else {"channel": channel}
    env = ncs_env(gym.make(env_id, **changed))
    if certificate_file is None:
        certificate = certificate_for(env.plant, env.contract)
    else:
        certificate = Certificate.load(certificate_file)
        require_valid(certificate, env.plant)
    return World(env_id, channel, env.plant, certificate, verify(certificate, env.plant))
