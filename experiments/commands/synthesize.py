"""Making and checking certificates from the command line."""

from __future__ import annotations

import json
from dataclasses import asdict

import gymnasium as gym
from tqdm import tqdm

from experiments.settings.certificates import SynthesizeSettings, VerifySettings
from ncs_gym import ChannelContract, LinearPlant, registration
from ncs_gym.envs.env import ncs_env
from ncs_gym.registration import ENTRY_POINTS
from shields import Certificate, CertificateError, Report, synthesize, verify
from shields.atomic_write import write_atomically


def synthesize_file(settings: SynthesizeSettings) -> None:
    """Runs `ncs synthesize`.

    Raises:
        Infeasible: If no certificate is found.
        OSError: If the file cannot be written.
    """
    plant = plant_of(settings.env)
    contract = contract_of_env(settings.env)
    if settings.max_age is not None:
        contract = ChannelContract(settings.max_age, contract.quantization_step if contract else 0.0)
    with tqdm(bar_format="{desc} [{elapsed}]", desc="synthesis", leave=False, disable=None) as line:
        certificate = synthesize(plant, settings.method, contract=contract, progress=line.set_description_str)
    certificate.save(settings.out)
    print(verify(certificate, plant))
    if certificate.method == "paper":
        also = "hold" if certificate.provenance["exact_conditions_hold"] else "were not shown to hold"
        print(f"guarantee: {certificate.provenance['guarantee']}; our exact conditions {also} for it too")
    print(f"valid; saved to {settings.out}")


def verify_file(settings: VerifySettings) -> None:
    """Runs `ncs verify`.

    Raises:
        CertificateError: If the certificate is damaged, of an unknown plant or does not verify.
        OSError: If the verdicts cannot be written.
    """
    certificate = Certificate.load(settings.file)
    env_id = settings.env or _matching_env(certificate)
    report = verify(certificate, plant_of(env_id))
    print(f"against the plant of {env_id}:\n{report}")
    if certificate.ages is not None:
        print(f"it rests on {certificate.ages.sets.contract}")
    if settings.out is not None:
        write_atomically(settings.out, json.dumps(_as_json(report, env_id), indent=1) + "\n")
    if not report.valid:
        broken = sum(not condition.holds for condition in report.conditions)
        raise CertificateError(
            f"{settings.file} does not verify: {broken} of {len(report.conditions)} conditions broken"
        )
    print("valid")


def plant_of(env_id: str) -> LinearPlant:
    """Returns the plant of a registered environment.

    Raises:
        ValueError: If the id is not one of ours that has a plant of its own.
    """
    if env_id not in _with_plant():
        raise ValueError(f"unknown environment {env_id!r}; known are {', '.join(_with_plant())}")
    return ncs_env(gym.make(env_id)).plant


def contract_of_env(env_id: str) -> ChannelContract | None:
    """Returns the channel contract a registered environment rests on; None for a stable plant."""
    return ncs_env(gym.make(env_id)).contract


def _with_plant() -> list[str]:
    return [env_id for env_id, name in ENTRY_POINTS.items() if getattr(registration, name).plant is not None]


def _matching_env(certificate: Certificate) -> str:
    for env_id in _with_plant():
        if plant_of(env_id).fingerprint == certificate.fingerprint:
            return env_id
    raise CertificateError(
        "the certificate belongs to no registered environment's plant; "
        "for one of your own call shields.verify(certificate, plant)"
    )


def _as_json(report: Report, env_id: str) -> dict:
    return {"env": env_id, "valid": report.valid, "conditions": [asdict(condition) for condition in report.conditions]}
