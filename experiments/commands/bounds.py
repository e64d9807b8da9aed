"""`ncs bounds`: half-widths of disturbances that a record of a plant proves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from experiments.runs.output_folder import require_place
from ncs_gym import LinearPlant, Sum, Through, bounds_from_recording
from ncs_gym.network.packet_log import table_rows
from ncs_gym.plants.linear_plant import of_outputs
from ncs_gym.reading import LARGEST_LOG, read_file, require_packets
from ncs_gym.validation import counted, shown


@dataclass(frozen=True, kw_only=True)
class BoundsSettings:
    """Says what bounds of a plant's disturbances a record of it proves, and writes a plant with them.

    Attributes:
        file: A table (CSV, or Parquet where pyarrow is installed) with the plant's inputs and outputs by name as
            columns and a row per step: outputs as sampled, then the input that acted, which may be empty in the last
            row; none as deviations from an operating point. An output that is not a state is y1, y2, ... by its number.
            Further columns are not read.
        plant: File of the plant (`LinearPlant.save`). Its disturbance says along which directions to seek: E of
            Through(E, ...), else every state.
        sensor: Half-widths of the noise of each output, as of a data sheet; by default the plant's own.
        factor: Writes the plant with this many times (>= 1) the half-widths found: your claim of what may still come.
        of: Which half-widths: "upper", or "explaining" where outputs leave no upper bound.
        out: File for the plant with these bounds, for `ncs synthesize --plant`. Sensor noise is as above; the first
            error is what one sample tells, or the plant's own where one does not tell all states.
    """

    file: tyro.conf.Positional[Path]
    plant: Path
    sensor: tuple[float, ...] = ()
    factor: float | None = None
    of: Literal["upper", "explaining"] = "upper"
    out: Path | None = None

    def __post_init__(self) -> None:
        if (self.factor is None) != (self.out is None):
            raise ValueError("a plant is written with --out FILE and --factor, by which you multiply what was found")


def bounds(settings: BoundsSettings) -> None:
    """Runs `ncs bounds`."""
    require_place(settings.out)
    plant = LinearPlant.load(settings.plant)
    n = len(plant.model.A)
    outputs = of_outputs(plant.model.H, plant.state_names[:n])
    inputs, measured = _read(settings.file, [*plant.input_names], outputs)
    parts = plant.bounds.disturbance.parts
    E = np.hstack([each.E for each in parts]) if all(isinstance(each, Through) for each in parts) else None
    sensor = settings.sensor or plant.bounds.sensor.sized(plant.p).support(np.eye(plant.p))
    labels = {"states": dict.fromkeys(plant.state_names[:n]), "inputs": dict.fromkeys(plant.input_names)}
    found = bounds_from_recording(plant.model, inputs, measured, E, sensor=sensor, labels=labels)
    print(found)
    if settings.out is not None and settings.factor is not None:
        first = None if np.isfinite(found.first_error).all() else plant.bounds.first_error
        given = found.bounds(settings.factor, of=settings.of, first_error=first)
        disturbance = Sum((given.disturbance, *(each for each in parts if each.is_left_out)))  # a remainder stays
        replace(plant, bounds=replace(given, disturbance=disturbance)).save(settings.out)
        print(f"saved to {settings.out}")


def _read(path: Path, inputs: list[str], outputs: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Returns inputs, shape (N, m), and outputs, (N, p) or (N + 1, p), of a table with these columns."""
    wanted = [*inputs, *outputs]
    forms = f"a record has the columns {', '.join(wanted)} of numbers, and a row for each step"

    def chosen(names: list[str]) -> list[str]:
        for each in wanted:
            if names.count(each) != 1:
                raise ValueError(f"it has {counted(names.count(each), 'column')} named {shown(each)}; {forms}")
        return wanted

    try:
        rows = []
        for row in table_rows(read_file(path, LARGEST_LOG), chosen, forms):
            rows.append(row)
            require_packets(len(rows))
        if not rows:
            raise ValueError(f"it has no rows; {forms}")
    except OSError as error:
        raise ValueError(f"cannot read the record in {shown(path)}: {error.strerror or error}") from error
    except ValueError as error:
        why = f"it is no text in UTF-8; {forms}" if isinstance(error, UnicodeDecodeError) else error
        raise ValueError(f"{shown(path)}: {why}") from None
    table, m = np.reshape(rows, (-1, len(wanted))), len(inputs)
    ends_open = bool(np.isnan(table[-1, :m]).all())
    acted, measured = table[: len(table) - ends_open, :m], table[:, m:]
    for numbers, names in ((acted, inputs), (measured, outputs)):
        if np.isnan(numbers).any():
            row, column = np.argwhere(np.isnan(numbers))[0]
            raise ValueError(
                f"{shown(path)}: row {row + 1} has no {shown(names[column])}; give a part of the record without gaps"
            )
    return acted, measured
