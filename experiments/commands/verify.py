"""`ncs verify`: checks a certificate in exact arithmetic, and writes its safety filter in C."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

import shields
from experiments.runs.loops import PlantInUse, plant_in_use, registered_env
from experiments.runs.output_folder import require_place, write_json
from experiments.settings import PlantSettings
from experiments.terminal import wrapped
from ncs_gym.registration import registered_ids
from ncs_gym.validation import counted
from shields import Certificate, CertificateError
from shields.export import export_c
from shields.held import held_text


@dataclass(frozen=True, kw_only=True)
class VerifySettings(PlantSettings):
    """Verifies a certificate in exact arithmetic, says what it keeps, and writes its safety filter in C99 for a board.

    Without --env and --plant the registered environment whose plant has the certificate's fingerprint is found.

    Attributes:
        file: File of the certificate (JSON).
        out: File for the verdicts (JSON).
        c: Output folder for the filter in C99 with test vectors, of a polytope under a channel contract.
        single: Write the rows of the safe set as float, which needs less memory and is faster on a board that computes
            in single precision; the estimate stays double.
    """

    file: tyro.conf.Positional[Path]
    out: Path | None = None
    c: Path | None = None
    single: Annotated[bool, tyro.conf.arg(name="float")] = False


def verify(settings: VerifySettings) -> None:
    """Runs `ncs verify`."""
    require_place(settings.out)
    certificate = Certificate.load(settings.file)
    found = plant_in_use(settings.env or ("" if settings.plant else _matching_env(certificate)), settings.plant)
    plant, origin = found.plant, found.origin
    report = shields.verify(certificate, plant)
    print(f"{settings.file}\nagainst the plant of {origin}:\n{report}")
    conditions = [asdict(condition) for condition in report.conditions]
    write_json(settings.out, {"env": origin, "valid": report.valid, "conditions": conditions})
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
    input_delay = found.input_delay if certificate.contract == found.contract else 0
    try:
        held = held_text(certificate, plant, input_delay)
    except ValueError as error:  # a certificate that no shield can use verifies, too
        held = f"  not known: {error}"
    print(f"What can be held:\n{held}")
    if (silence := shields.silence_of(certificate, plant, input_delay)) is not None:
        print(f"Beyond the contract:\n{silence}")
    if settings.c is not None:
        _export(certificate, found, settings.c, single=settings.single)
    print(f"{settings.file} verifies")


def _export(certificate: Certificate, found: PlantInUse, folder: Path, *, single: bool) -> None:
    if found.input_delay or found.asks:
        does = "takes samples on request" if found.asks else "commits inputs ahead"
        raise CertificateError(f"the filter is not exported, since {found.origin} {does}: give the plant's file")
    table = export_c(certificate, found.plant, folder, single=single)
    age = counted(table.sizes["H"], "step")
    print(wrapped(f"The filter takes {table.cost}."))
    print(
        wrapped(
            "It assumes that inputs act at the step at which they are decided, and that the newest sample is at most "
            f"{age} old at every step. Where there is a compiler, `make` in {folder} checks it."
        )
    )


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
