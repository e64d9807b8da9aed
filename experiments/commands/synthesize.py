"""`ncs synthesize`: makes a certificate for the plant of an environment or of a file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import shields
from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place
from experiments.settings import require_one_plant
from ncs_gym import ChannelContract, LinearPlant
from shields.packaged_certificates import synthesis_status


@dataclass(frozen=True, kw_only=True)
class SynthesizeSettings:
    """Synthesizes a certificate for an environment's plant, verifies it exactly and saves it.

    Attributes:
        env: Id of an environment with a plant of its own; module:id first imports the module, which registers one of
            your own (`ncs_gym.register_plant`). By default ncs_gym/TruckTrailerCruise-v0.
        plant: File of a plant that `LinearPlant.save` wrote, in place of an environment's.
        safe_set: What a shield with this certificate keeps: the ellipsoid, or the largest polytope that the same gain
            keeps in the safe box, which leaves the policy more room. By default the polytope.
        between_samples: Times per step at which the safe box counts, for a claim at all times; by default the plant's
            own; 1 for the sampling instants alone.
        time_limit: Seconds of the processor's time after which the best certificate so far is verified and saved, and
            says so; None for no limit: then the search ends by counted work, on every machine alike.
        out: File for the certificate (JSON).
        max_age: Largest measurement age of the channel contract [steps]; by default the environment's contract, none
            for the plant of a file.
        quantization_step: Coarsest quantization that the channel contract allows; by default the environment's, none
            for the plant of a file.
    """

    env: str | None = None
    plant: Path | None = None
    safe_set: Literal["polytope", "ellipsoid"] | None = None
    between_samples: int | None = None
    time_limit: float | None = 60.0
    out: Path = Path("certificate.json")
    max_age: int | None = None
    quantization_step: float | None = None

    def __post_init__(self) -> None:
        require_one_plant(self)


def synthesize(settings: SynthesizeSettings) -> None:
    """Runs `ncs synthesize`."""
    require_place(settings.out)
    if settings.plant is None:
        env = registered_env(settings.env or "ncs_gym/TruckTrailerCruise-v0")
        plant, own, input_delay = env.plant, env.certificate_contract, env.downlink_protocol.input_delay
    else:
        plant, own, input_delay = LinearPlant.load(settings.plant), None, 0
    if settings.between_samples is not None:
        plant = replace(plant, limits=replace(plant.limits, between_samples=settings.between_samples))
    contract = changed_contract(own, settings.max_age, settings.quantization_step)
    with synthesis_status() as show:
        certificate = shields.synthesize(
            plant,
            contract=contract,
            safe_set=settings.safe_set,
            time_limit=settings.time_limit,
            progress=show,
        )
    certificate.save(settings.out)
    print(certificate, shields.verify(certificate, plant), sep="\n")
    # Under another contract than the environment's no downlink is known.
    silence = shields.silence_of(certificate, plant, input_delay if contract == own else 0)
    if silence is not None:
        print(f"Beyond the contract:\n{silence}")
    print(f"saved to {settings.out}")


def changed_contract(
    contract: ChannelContract | None, max_age: int | None, quantization_step: float | None
) -> ChannelContract | None:
    """Returns a channel contract with what is given, None for what stays.

    Raises:
        ValueError: If a value is out of range, or there is a quantization step and no age.
    """
    if contract is not None:
        max_age = contract.max_age if max_age is None else max_age
        quantization_step = contract.quantization_step if quantization_step is None else quantization_step
    if max_age is None and quantization_step is not None:
        raise ValueError("--quantization-step belongs to a contract of the channel: give --max-age, too")
    return None if max_age is None else ChannelContract(max_age, quantization_step or 0.0)
