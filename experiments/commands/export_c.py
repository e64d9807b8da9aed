"""`ncs export-c`: writes a safety filter in C99, with test vectors and what checks them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from experiments.runs.loops import registered_env
from experiments.terminal import wrapped
from ncs_gym import LinearPlant
from ncs_gym.validation import counted
from shields import Certificate, CertificateError, export


@dataclass(frozen=True, kw_only=True)
class ExportCSettings:
    """Writes a safety filter in C99 for a board, with test vectors that check it.

    Attributes:
        file: File of the certificate (JSON): with a polytope, under a channel contract.
        plant: File of the plant that `LinearPlant.save` wrote, or id of an environment with a plant of its own.
        out: Output folder.
        single: Write the rows of the safe set as float, which needs less memory and is faster on a board that computes
            in single precision; the estimate stays double.
    """

    file: tyro.conf.Positional[Path]
    plant: str
    out: Path = Path("filter")
    single: Annotated[bool, tyro.conf.arg(name="float")] = False


def export_c(settings: ExportCSettings) -> None:
    """Runs `ncs export-c`."""
    certificate = Certificate.load(settings.file)
    if Path(settings.plant).is_file():
        plant = LinearPlant.load(settings.plant)
    else:
        env = registered_env(settings.plant)
        plant = env.plant
        if env.downlink_protocol.input_delay or env.channel.on_request:
            does = "takes samples on request" if env.channel.on_request else "commits inputs ahead"
            raise CertificateError(f"the filter is not exported, since {settings.plant} {does}: give the plant's file")
    table = export.export_c(certificate, plant, settings.out, single=settings.single)
    age = counted(table.sizes["H"], "step")
    print(wrapped(f"The filter takes {table.cost}."))
    print(
        wrapped(
            "It assumes that inputs act at the step at which they are decided, and that the newest sample is at most "
            f"{age} old at every step. Where there is a compiler, `make` checks it."
        )
    )
    print(f"saved to {settings.out}")
