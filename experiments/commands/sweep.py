"""`ncs sweep`: the same comparison over a grid of channels, and of masses that differ from the model's."""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import product
from typing import Any

import pandas as pd

from agents.loop import LoopConfig
from experiments.analysis.episodes import arm_summaries, episodes_table, parquet, training_table
from experiments.backends.execution import results_of
from experiments.commands import short_version
from experiments.plots.heatmaps import sweep_map
from experiments.report.text_tables import sweep_table
from experiments.runs.arms import full_names, is_any_trained, require_arms, run_of_arm
from experiments.runs.loops import certificate_of, loop_config
from experiments.runs.output_folder import claim_folder, write_results
from experiments.runs.policies import CERTIFICATES
from experiments.runs.provenance import experiment_provenance
from experiments.settings import SweepSettings
from experiments.settings.arguments import id_alone
from experiments.terminal import wrapped
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import counted

# Budget of `--smoke`, which takes the first and the last value of each side of the grid.
_SMOKE = {"steps": 1_024, "episodes": 4, "seeds": 1}
# The sides of the grid: names of settings, and of the values at a point.
_SIDES = {
    "losses": "loss",
    "delays": "delay",
    "quantization_steps": "quantization_step",
    "burst_lengths": "burst_length",
    "mass_factors": "mass_factor",
    "downlink_losses": "downlink_loss",
}
# Value of each side by its name; None for the environment's own.
_GridPoint = dict[str, Any]


def sweep(settings: SweepSettings) -> None:
    """Runs `ncs sweep`."""
    ends = {name: tuple(dict.fromkeys((side[0], side[-1]))) for name in _SIDES if (side := getattr(settings, name))}
    settings = short_version(settings, **_SMOKE, **ends)
    settings = replace(settings, arms=full_names(settings.arms, settings.mode))
    points = grid_points(settings)
    for name in ("loss", "delay", "burst_length"):
        if settings.channel.get(name) is not None:
            raise ValueError(f"--channel {name} is a side of the grid: give its values there")
    loops = [loop_at(settings, point) for point in points]
    require_arms(settings, loops[0], settings.arms)
    certificates = [certificate_of(loop, settings.certificate, settings.safe_set) for loop in loops]
    claim_folder("sweep", settings.completed)
    if is_any_trained(settings, settings.arms):
        print(wrapped(settings.agent_line), flush=True)
    settings = settings.completed
    runs = [
        run_of_arm(settings, loop, certificate, name, index, grid_point=name_of(point))
        for point, loop, certificate in zip(points, loops, certificates, strict=True)
        for index in range(settings.seeds)
        for name in settings.arms
    ]
    results = results_of(runs, settings.out, settings)
    per_point = len(runs) // len(points)
    parts = [results[i * per_point : (i + 1) * per_point] for i in range(len(points))]
    arms = [arm_summaries(part, settings.mode) for part in parts]
    common = {"environment": id_alone(settings.env), "algorithm": settings.algo}
    sides = [common | {side: float("nan" if at is None else at) for side, at in point.items()} for point in points]
    losses = [{"mean_loss": ncs_env(loop.single()).channel.mean_loss} for loop in loops]
    summary = {
        "cells": [point | lost | {"arms": each} for point, lost, each in zip(points, losses, arms, strict=True)]
    } | experiment_provenance(settings, loops[0], certificates[0], runs)
    figure = sweep_map(summary["cells"], settings.arms)
    certificates[0].save(settings.out / "certificate.json")
    (settings.out / CERTIFICATES).mkdir(exist_ok=True)
    for point, certificate in zip(points, certificates, strict=True):
        certificate.save(settings.out / CERTIFICATES / f"{name_of(point)}.json")
    files = {
        f"{name}.parquet": parquet(pd.concat(table(p, **side) for p, side in zip(parts, sides, strict=True)), summary)
        for name, table in (("episodes", episodes_table), ("training", training_table))
    }
    write_results(settings.out, summary, files, {"violations": (figure.caption, figure.png)})
    count = counted(settings.seeds, "run")
    print(f"{settings.env}: {count} per arm and channel\n", sweep_table(summary["cells"]), sep="\n")
    print(f"files: {settings.out}")


def grid_points(settings: SweepSettings) -> list[_GridPoint]:
    """Returns the points of the grid; raises ValueError if a side is empty or has a value twice."""
    own_unless_given = ("quantization_steps", "mass_factors", "downlink_losses")
    sides = {name: getattr(settings, name) or ((None,) if name in own_unless_given else ()) for name in _SIDES}
    for name, side in (sides | {"arms": settings.arms}).items():
        if not side or len(set(side)) != len(side):
            raise ValueError(f"--{name.replace('_', '-')} must be different values, at least one")
    return [dict(zip(_SIDES.values(), point, strict=True)) for point in product(*sides.values())]


def name_of(point: _GridPoint) -> str:
    """Returns the name of a point, a part of the names of its runs."""
    short = {"quantization_step": "q", "burst_length": "burst", "mass_factor": "mass", "downlink_loss": "down"}
    return "-".join(f"{short.get(name, name)}{value}" for name, value in point.items() if value is not None)


def loop_at(settings: SweepSettings, point: _GridPoint) -> LoopConfig:
    """Returns the control loop at a point."""
    changes = {name: point[name] for name in ("loss", "delay", "quantization_step") if point[name] is not None}
    if point["burst_length"] and point["loss"]:
        changes["burst_length"] = point["burst_length"]
    loop = loop_config(settings.env, settings.channel | changes, between_samples=settings.between_samples)
    env, kwargs = ncs_env(loop.single()), {}
    if point["mass_factor"] is not None:
        kwargs["process"] = asdict(env.process.with_mass(point["mass_factor"]))  # pyright: ignore
    if point["downlink_loss"] is not None:
        if env.downlink is None:
            raise ValueError(f"{settings.env} has an ideal downlink, which loses nothing: choose one with a downlink")
        kwargs["downlink"] = asdict(replace(env.downlink, loss=point["downlink_loss"]))
    return loop.with_kwargs(**kwargs)
