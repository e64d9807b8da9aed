"""`ncs verify`: checks a certificate in exact arithmetic."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

import shields
from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place
from experiments.settings import require_one_plant
from ncs_gym import LinearPlant
from ncs_gym.registration import registered_ids
from shields import Certificate, CertificateError
from shields.atomic_write import write_atomically
from shields.held import held_text


@dataclass(frozen=True, kw_only=True)
class VerifySettings:
    """Verifies a certificate in exact rational arithmetic against the plant it was made for.

    Attributes:
        file: File of the certificate (JSON).
        env: Id of an environment with a plant of its own, or module:id; without it, the one whose plant has the
            certificate's fingerprint.
        plant: File of a plant that `LinearPlant.save` wrote, in place of an environment's.
        out: File for the verdicts (JSON).
    """

    file: tyro.conf.Positional[Path]
    env: str | None = None
    plant: Path | None = None
    out: Path | None = None

    def __post_init__(self) -> None:
        require_one_plant(self)


def verify(settings: VerifySettings) -> None:
    """Runs `ncs verify`."""
    require_place(settings.out)
    certificate = Certificate.load(settings.file)
    input_delay = 0
    if settings.plant is None:
        origin = settings.env or _matching_env(certificate)
        env = registered_env(origin)
        plant = env.plant
        if certificate.contract == env.certificate_contract:
            input_delay = env.downlink_protocol.input_delay
    else:
        origin, plant = str(settings.plant), LinearPlant.load(settings.plant)
    report = shields.verify(certificate, plant)
    print(f"{settings.file}\nagainst the plant of {origin}:\n{report}")
    if settings.out is not None:
        conditions = [asdict(condition) for condition in report.conditions]
        document = {"env": origin, "valid": report.valid, "conditions": conditions}
        write_atomically(settings.out, json.dumps(document, indent=1) + "\n")
    if not report.valid:
        if plant.fingerprint != certificate.fingerprint:
            raise CertificateError(
                f"{settings.file} does not verify: it was made for another plant than that of {origin}; without --env "
                "and --plant the registered environment that it belongs to is found"
            )
        broken = sum(not condition.holds for condition in report.conditions)
        raise CertificateError(
            f"{settings.file} does not verify: {broken} of {len(report.conditions)} conditions broken"
        )
    print(certificate)
    try:
        held = held_text(certificate, plant, input_delay)
    except ValueError as error:  # a certificate that no shield can use verifies, too
        held = f"  not known: {error}"
    print(f"What can be held:\n{held}")
    if (silence := shields.silence_of(certificate, plant, input_delay)) is not None:
        print(f"Beyond the contract:\n{silence}")
    print(f"{settings.file} verifies")


def _matching_env(certificate: Certificate) -> str:
    """Returns the registered environment with the plant of a certificate, of several one with its contract."""
    envs = {env_id: registered_env(env_id) for env_id in registered_ids()}
    found = [env_id for env_id, env in envs.items() if env.plant.fingerprint == certificate.fingerprint]
    if not found:
        raise CertificateError(
            "the certificate belongs to no registered environment's plant; "
            "for one of your own give --env module:id or --plant FILE, or call shields.verify(certificate, plant)"
        )
    return next((each for each in found if envs[each].certificate_contract == certificate.contract), found[0])
