"""`ncs requirements`: under which contracts of the network a plant is certifiable."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import shields
from experiments.runs.loops import plant_in_use
from experiments.runs.output_folder import require_place, write_json
from experiments.settings import PlantSettings
from experiments.terminal import text_table, wrapped
from ncs_gym import LinearPlant
from ncs_gym.network.channel import in_time
from ncs_gym.validation import counted
from shields.packaged_certificates import synthesis_status
from shields.synthesis.network_requirements import AGES


@dataclass(frozen=True, kw_only=True)
class RequirementsSettings(PlantSettings):
    """Finds how old and how coarse the samples of a plant may be, so that it is certifiable.

    Prints what share of the safe box a certificate keeps, - where none was found (which does not prove that there is
    none). By default the plant is that of ncs_gym/CartPole-v0.

    Attributes:
        ages: Largest ages of the newest sample when an input takes effect [steps]; by default up to 32, and the
            environment's.
        resolutions: Quantization steps, in the units of the measurements, 0 for none; by default the environment's.
        out: File for the table with its certificates (JSON).
    """

    ages: tuple[int, ...] = ()
    resolutions: tuple[float, ...] = ()
    out: Path | None = None


def requirements(settings: RequirementsSettings) -> None:
    """Runs `ncs requirements`."""
    plant, today, delay = plant_in_use(settings.env or "ncs_gym/CartPole-v0", settings.plant)[1:4]
    ages = settings.ages or tuple({*AGES, *(() if today is None else (today.max_age,))})
    resolutions = settings.resolutions or (0.0 if today is None else today.quantization_step,)
    require_place(settings.out)
    with synthesis_status() as show:
        found = shields.requirements(plant, ages=ages, resolutions=resolutions, progress=show)
    certified = {each.checksum: each for row in found.certificates for each in row if each is not None}
    print(f"share of the box [%], by age and resolution of samples\n{text_table(found.cells)}\n")
    for step in found.resolutions:
        largest, where = found.largest_age(step), f"Rounded to {step:g}" if step else "Not rounded"
        if largest is None:
            text = f"{where}: no certificate was found; `ncs synthesize --max-age {found.ages[0]}` says what binds."
        else:
            text = f"{where}: the newest sample may be {_time(largest, plant)} old when an input takes effect"
            beyond = [age for age in found.ages if age > largest]
            text += f"; for {beyond[0]} no certificate was found." if beyond else "; no older one was asked."
        print(wrapped(text))
    if today is not None:
        late = f", of which inputs are {counted(delay, 'step')} late" if delay else ""
        rounded = f"rounded to {today.quantization_step:g}" if today.quantization_step else "not rounded"
        print(wrapped(f"Today's contract: {_time(today.max_age, plant)}{late}, {rounded}."))
    if settings.out is not None:
        documents = {checksum: certificate.document for checksum, certificate in certified.items()}
        content = found.document | {"plant": plant.fingerprint, "documents": documents}
        write_json(settings.out, content)
        print(f"saved to {settings.out}")


def _time(age: int, plant: LinearPlant) -> str:
    return f"{counted(age, 'step')} ({in_time(age * plant.dt)})"
