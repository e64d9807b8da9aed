"""The same comparison over a grid of channels."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

from experiments.analysis.parquet_tables import parquet
from experiments.analysis.summary import summarize_arm
from experiments.backends.execution import results_of
from experiments.commands.compare import grouped, prepare, provenance, unit_of
from experiments.plots.heatmaps import heatmaps_of
from experiments.report.comparison import sweep_report
from experiments.runs.arms import arm_of
from experiments.runs.experiment_setup import World, world_of
from experiments.runs.training_run import Unit, UnitResult
from experiments.settings.channel import ChannelSettings
from experiments.settings.learning import SweepSettings
from experiments.settings.settings_file import save_settings
from shields.atomic_write import write_atomically


@dataclass(frozen=True)
class Cell:
    """A point of the grid.

    Attributes:
        loss: Probability that a packet is lost.
        delay: [steps].
        quantization_step: None for the environment's own.
        burst_length: Mean number of packets lost in a row; 0 for independent losses.
    """

    loss: float
    delay: int
    quantization_step: float | None
    burst_length: float

    @property
    def name(self) -> str:
        """For files."""
        rounding = "" if self.quantization_step is None else f"-q{self.quantization_step}"
        return f"loss{self.loss}-delay{self.delay}{rounding}-burst{self.burst_length}"

    def channel(self, base: ChannelSettings) -> ChannelSettings:
        """Returns the changes of the environment's channel that make this cell's."""
        bursts = None if self.burst_length == 0.0 or self.loss == 0.0 else self.burst_length
        rounding = base.quantization_step if self.quantization_step is None else self.quantization_step
        return replace(base, loss=self.loss, delay=self.delay, quantization_step=rounding, burst_length=bursts)


def sweep(settings: SweepSettings) -> None:
    """Runs `ncs sweep`.

    Raises:
        ValueError: If a setting is out of range, a channel impossible, or a stored result damaged.
        OSError: If the output folder cannot be written.
        CertificateError: If a given certificate does not verify.
        Infeasible: If no certificate is found.
        RunError: If a run fails.
        ClusterError: If a cluster cannot run them.
    """
    cells = cells_of(settings)
    for name in ("loss", "delay", "burst_length"):
        if getattr(settings.channel, name) is not None:
            raise ValueError(f"--channel.{name.replace('_', '-')} is a side of the grid: give its values there")
    for name in settings.arms:
        arm_of(name, settings.mode)
    worlds = [world_of(settings.env, cell.channel(settings.channel), settings.certificate) for cell in cells]
    prepare(settings.out)
    save_settings(settings.out / "settings.json", "sweep", settings)
    units = [unit for cell, world in zip(cells, worlds, strict=True) for unit in _units(settings, cell, world)]
    results = results_of(units, settings.out, settings)
    per_cell = len(units) // len(cells)
    parts = [results[i * per_cell : (i + 1) * per_cell] for i in range(len(cells))]
    rows = [row for cell, part in zip(cells, parts, strict=True) for row in _rows(cell, part)]
    summary = {
        "cells": [asdict(cell) | {"arms": _arms(part)} for cell, part in zip(cells, parts, strict=True)],
        "units": {unit.name: unit.key for unit in units},
        "seeds": {unit.index: {"training": unit.training_seed, "evaluation": unit.evaluation_seed} for unit in units},
    } | provenance("sweep", settings, worlds[0])
    figures = heatmaps_of(summary, settings.arms)
    for name, (_, png) in figures.items():
        write_atomically(settings.out / "figures" / f"{name}.png", png)
    worlds[0].certificate.save(settings.out / "certificate.json")
    write_atomically(settings.out / "sweep.parquet", parquet(rows, provenance("sweep", settings, worlds[0])))
    page = sweep_report(summary, worlds[0].verification, {caption: png for caption, png in figures.values()})
    write_atomically(settings.out / "report.html", page)
    write_atomically(settings.out / "summary.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    runs = "1 run" if settings.seeds == 1 else f"{settings.seeds} runs"
    print(f"{settings.env}: {runs} per arm and channel\n", sweep_text(summary), sep="\n")
    print(f"files: {settings.out}")


def cells_of(settings: SweepSettings) -> list[Cell]:
    """Returns the points of the grid.

    Raises:
        ValueError: If a side of it is empty or names a value twice.
    """
    sides = {
        "losses": settings.losses,
        "delays": settings.delays,
        "quantization_steps": settings.quantization_steps or (None,),
        "burst_lengths": settings.burst_lengths,
        "arms": settings.arms,
    }
    for name, side in sides.items():
        if not side or len(set(side)) != len(side):
            raise ValueError(f"--{name.replace('_', '-')} must be different values, at least one")
    del sides["arms"]
    return [Cell(*point) for point in product(*sides.values())]


def sweep_text(summary: dict[str, Any]) -> str:
    """Returns the table for a terminal: a row per channel and arm."""
    header = [
        "loss",
        "delay",
        "rounding",
        "burst",
        "arm",
        "violating episodes",
        "training steps",
        "overridden",
        "return",
    ]
    rows = [header]
    for cell in summary["cells"]:
        rounding = "own" if cell["quantization_step"] is None else f"{cell['quantization_step']:g}"
        place = [
            f"{cell['loss']:g}",
            str(cell["delay"]),
            rounding,
            f"{cell['burst_length']:g}" if cell["burst_length"] else "none",
        ]
        for name, arm in cell["arms"].items():
            rows.append(
                [
                    *place,
                    name,
                    f"{arm['eval_violating_episodes']:,} of {arm['eval_episodes']:,}",
                    f"{arm['train_violation_steps']:,} of {arm['train_steps']:,}",
                    "-" if name in ("unshielded", "penalized") else f"{100 * arm['intervention_rate']:.1f} %",
                    f"{arm['eval_return_mean']:.1f}",
                ]
            )
    widths = [max(len(row[column]) for row in rows) for column in range(len(header))]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def _units(settings: SweepSettings, cell: Cell, world: World) -> list[Unit]:
    units = [unit_of(settings, world, name, index) for index in range(settings.seeds) for name in settings.arms]
    return [replace(unit, place=cell.name) for unit in units]


def _arms(results: Sequence[UnitResult]) -> dict[str, Any]:
    return {name: summarize_arm(runs, fixed_policy=False) for name, runs in grouped(results).items()}


def _rows(cell: Cell, results: Sequence[UnitResult]) -> list[dict[str, Any]]:
    """Returns one row per unit."""
    rows = []
    for result in results:
        summary = summarize_arm([result], fixed_policy=False)
        numbers = {name: value for name, value in summary.items() if isinstance(value, (int, float))}
        rows.append(asdict(cell) | {"arm": result.arm, "run": result.index} | numbers)
    return rows
