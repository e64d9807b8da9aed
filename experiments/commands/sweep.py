"""`ncs sweep`: the same comparison over a grid of channels, and of masses that differ from the model's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product

import pandas as pd

from agents.loop import LoopConfig
from experiments.analysis.episodes import episodes_table, parquet
from experiments.analysis.summary import arm_summaries
from experiments.analysis.tables import sweep_table
from experiments.analysis.terminal_text import wrapped
from experiments.backends.execution import results_of
from experiments.commands import short_version
from experiments.plots.heatmaps import sweep_figures
from experiments.report import sweep_report
from experiments.runs import (
    Arm,
    certificate_of,
    claim_folder,
    experiment_provenance,
    loop_config,
    prepare_output,
    require_trainable,
    run_of_arm,
    write_results,
)
from experiments.settings import Assignments, SweepSettings
from ncs_gym.envs.env import ncs_env
from shields import Certificate, verify

# Budget of `--smoke`, and the sides of the grid of which it takes the first and the last value.
_SMOKE = {"steps": 1_024, "episodes": 4, "seeds": 1}
_SIDES = ("losses", "delays", "quantization_steps", "burst_lengths", "mass_factors", "downlink_losses")


@dataclass(frozen=True)
class _GridPoint:
    """One channel of the grid, and one mass.

    Attributes:
        loss: Probability that a packet is lost.
        delay: Delay of every packet [steps].
        quantization_step: Quantization step of the measurements; None for the environment's own.
        burst_length: Mean number of packets lost in a row; 0 for independent losses.
        mass_factor: Of the mass in the process; None for the environment's own.
        downlink_loss: Probability that a command is lost; None for the environment's own downlink.
    """

    loss: float
    delay: int
    quantization_step: float | None
    burst_length: float
    mass_factor: float | None = None
    downlink_loss: float | None = None

    @property
    def name(self) -> str:
        """Name of the point in file names."""
        quantization = "" if self.quantization_step is None else f"-q{self.quantization_step}"
        mass = "" if self.mass_factor is None else f"-mass{self.mass_factor}"
        downlink = "" if self.downlink_loss is None else f"-down{self.downlink_loss}"
        return f"loss{self.loss}-delay{self.delay}{quantization}-burst{self.burst_length}{mass}{downlink}"

    @property
    def columns(self) -> dict[str, float]:
        """What all rows of the table of episodes at this point have in common; NaN for the environment's own."""
        return {name: float("nan" if value is None else value) for name, value in asdict(self).items()}

    def channel(self, base: Assignments) -> Assignments:
        """Returns the changes of the environment's channel that make this point's channel."""
        changes = base | {"loss": self.loss, "delay": self.delay}
        if self.quantization_step is not None:
            changes["quantization_step"] = self.quantization_step
        if self.burst_length != 0.0 and self.loss != 0.0:
            changes["burst_length"] = self.burst_length
        return changes

    def loop(self, settings: SweepSettings) -> LoopConfig:
        """Returns the control loop with the channels and the mass of this point."""
        channel = self.channel(settings.channel)
        return loop_config(settings.env, channel, mass_factor=self.mass_factor, downlink_loss=self.downlink_loss)


def sweep(settings: SweepSettings) -> None:
    """Runs `ncs sweep`.

    Raises:
        ValueError: If a setting is out of range, a channel impossible, or a stored result damaged.
        FolderInUseError: If another command is writing to the output folder.
        OtherResultsError: If the output folder holds finished results of other settings.
        OSError: If the output folder cannot be written.
        CertificateError: If a given certificate does not verify.
        Infeasible: If no certificate is found.
        RunError: If a run fails.
        ClusterError: If a cluster cannot execute the runs.
    """
    ends = {name: tuple(dict.fromkeys((side[0], side[-1]))) for name in _SIDES if (side := getattr(settings, name))}
    settings = short_version(settings, **_SMOKE, **ends)
    points = _grid_points(settings)
    for name in ("loss", "delay", "burst_length"):
        if settings.channel.get(name) is not None:
            raise ValueError(f"--channel {name} is a side of the grid: give its values there")
    for name in settings.arms:
        Arm.of(name, settings.mode)
    loops = [point.loop(settings) for point in points]
    require_trainable(settings, loops[0])
    certificates = [certificate_of(loop, settings.certificate, settings.safe_set) for loop in loops]
    with claim_folder("sweep", settings.completed):
        _sweep_in_folder(settings, points, loops, certificates)


def _sweep_in_folder(
    settings: SweepSettings,
    points: Sequence[_GridPoint],
    loops: Sequence[LoopConfig],
    certificates: Sequence[Certificate],
) -> None:
    """Executes what is missing, prints the table and writes the files."""
    prepare_output(settings.out)
    print(wrapped(settings.agent_line), flush=True)
    settings = settings.completed
    runs = [
        run_of_arm(settings, loop, certificate, name, index, grid_point=point.name)
        for point, loop, certificate in zip(points, loops, certificates, strict=True)
        for index in range(settings.seeds)
        for name in settings.arms
    ]
    results = results_of(runs, settings.out, settings)
    per_point = len(runs) // len(points)
    parts = [
        episodes_table(results[i * per_point : (i + 1) * per_point], **point.columns) for i, point in enumerate(points)
    ]
    arms = [arm_summaries(part, settings.mode) for part in parts]
    summary = {
        "cells": [asdict(point) | {"arms": each} for point, each in zip(points, arms, strict=True)]
    } | experiment_provenance("sweep", settings, loops[0], certificates[0], runs)
    figures = sweep_figures(summary, settings.arms)
    certificates[0].save(settings.out / "certificate.json")
    verification = verify(certificates[0], ncs_env(loops[0].single()).plant)
    files = {
        "episodes.parquet": parquet(pd.concat(parts), summary),
        "report.html": sweep_report(summary, verification, dict(figures.values())),
    }
    write_results(settings.out, summary, files, figures)
    count = "1 run" if settings.seeds == 1 else f"{settings.seeds} runs"
    print(f"{settings.env}: {count} per arm and channel\n", sweep_table(summary["cells"]), sep="\n")
    print(f"files: {settings.out}")


def _grid_points(settings: SweepSettings) -> list[_GridPoint]:
    """Returns the points of the grid.

    Raises:
        ValueError: If a side of the grid is empty or names a value twice.
    """
    sides = {
        "losses": settings.losses,
        "delays": settings.delays,
        "quantization_steps": settings.quantization_steps or (None,),
        "burst_lengths": settings.burst_lengths,
        "mass_factors": settings.mass_factors or (None,),
        "downlink_losses": settings.downlink_losses or (None,),
        "arms": settings.arms,
    }
    for name, side in sides.items():
        if not side or len(set(side)) != len(side):
            raise ValueError(f"--{name.replace('_', '-')} must be different values, at least one")
    del sides["arms"]
    return [_GridPoint(*point) for point in product(*sides.values())]
