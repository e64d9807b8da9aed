"""`ncs verify`: checks a certificate in exact arithmetic."""

from __future__ import annotations

import json
from dataclasses import asdict

import shields
from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place
from experiments.settings import VerifySettings
from ncs_gym import LinearPlant
from ncs_gym.registration import registered_ids
from shields import Certificate, CertificateError
from shields.atomic_write import write_atomically


def verify(settings: VerifySettings) -> None:
    """Runs `ncs verify`."""
    require_place(settings.out)
    certificate = Certificate.load(settings.file)
    if settings.plant is None:
        origin = settings.env or _matching_env(certificate)
        plant = registered_env(origin).plant
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
    if (silence := shields.silence_of(certificate, plant)) is not None:
        print(f"Beyond the contract:\n{silence}")
    print(f"{settings.file} verifies")


def _matching_env(certificate: Certificate) -> str:
    for env_id in registered_ids():
        if registered_env(env_id).plant.fingerprint == certificate.fingerprint:
            return env_id
    raise CertificateError(
        "the certificate belongs to no registered environment's plant; "
        "for one of your own give --env module:id or --plant FILE, or call shields.verify(certificate, plant)"
    )
