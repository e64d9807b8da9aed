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
from shields.errors import SynthesisInterrupted
from shields.packaged_certificates import synthesis_status

_DEFAULT_ENV = "ncs_gym/TruckTrailerCruise-v0"


def synthesize(settings: SynthesizeSettings) -> None:
    """Runs `ncs synthesize`."""
    require_place(settings.out)
    plant, contract, input_delay = _problem(settings)
    try:
        with synthesis_status() as show:
            certificate = shields.synthesize(
                plant,
                contract=contract,
                safe_set=settings.safe_set,
                time_limit=settings.time_limit,
                progress=show,
            )
    except SynthesisInterrupted as interrupt:
        if interrupt.certificate is None:
            raise
        interrupt.certificate.save(settings.out)
        size = size_of(interrupt.certificate)
        raise SynthesisInterrupted(
            f"interrupted: the best certificate so far, which verifies ({size}), was saved to {settings.out}"
        ) from interrupt
    certificate.save(settings.out)
    print(certificate, shields.verify(certificate, plant), sep="\n")
    if (silence := shields.silence_of(certificate, plant, input_delay)) is not None:
        print(f"Beyond the contract:\n{silence}")
    print(f"saved to {settings.out}")


def _problem(settings: SynthesizeSettings) -> tuple[LinearPlant, ChannelContract | None, int]:
    """Returns the plant of a file or an environment, the contract with the changes asked for, and the downlink's part.

    That is 0 under another contract than the environment's.
    """
    if settings.plant is None:
        env = registered_env(settings.env or _DEFAULT_ENV)
        plant, own, input_delay = env.plant, env.certificate_contract, env.downlink_protocol.input_delay
    else:
        plant, own, input_delay = LinearPlant.load(settings.plant), None, 0
    if settings.between_samples is not None:
        plant = replace(plant, limits=replace(plant.limits, between_samples=settings.between_samples))
    contract = changed_contract(own, settings.max_age, settings.quantization_step)
    return plant, contract, input_delay if contract == own else 0
