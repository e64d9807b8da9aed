"""`ncs synthesize`: makes a certificate for the plant of an environment or of a file."""

from __future__ import annotations

from dataclasses import replace

import shields
from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place
from experiments.settings import SynthesizeSettings
from experiments.settings.certificates import changed_contract
from ncs_gym import ChannelContract, LinearPlant
from shields.certificate_text import size_of
from shields.certificates import synthesis_status
from shields.errors import SynthesisInterrupted

_DEFAULT_ENV = "ncs_gym/TruckTrailerCruise-v0"


def synthesize(settings: SynthesizeSettings) -> None:
    """Runs `ncs synthesize`."""
    require_place(settings.out)
    plant, contract = _plant_and_contract(settings)
    try:
        with synthesis_status() as show:
            certificate = shields.synthesize(
                plant,
                contract=contract,
                safe_set=settings.safe_set,
                search_gain=settings.search_gain,
                progress=show,
            )
    except SynthesisInterrupted as interrupt:
        if interrupt.certificate is None:
            raise
        interrupt.certificate.save(settings.out)
        size = size_of(interrupt.certificate.provenance)
        raise SynthesisInterrupted(
            f"interrupted: the best certificate so far, which verifies ({size}), was saved to {settings.out}"
        ) from interrupt
    certificate.save(settings.out)
    print(certificate, shields.verify(certificate, plant), sep="\n")
    if (silence := shields.silence_of(certificate, plant)) is not None:
        print(f"Beyond the contract:\n{silence}")
    print(f"saved to {settings.out}")


def _plant_and_contract(settings: SynthesizeSettings) -> tuple[LinearPlant, ChannelContract | None]:
    """Returns the plant of a file or an environment, and the contract of the environment with the changes asked for."""
    if settings.plant is None:
        env = registered_env(settings.env or _DEFAULT_ENV)
        plant, contract = env.plant, env.certificate_contract
    else:
        plant, contract = LinearPlant.load(settings.plant), None
    if settings.between_samples is not None:
        plant = replace(plant, between_samples=settings.between_samples)
    return plant, changed_contract(contract, settings.max_age, settings.quantization_step)
