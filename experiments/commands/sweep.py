"""`ncs sweep`: the same comparison over a grid of channels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import pandas as pd

from experiments.analysis.episodes import arm_summaries, episodes_table, parquet, training_table
from experiments.backends.execution import results_of
from experiments.report import sweep_table
from experiments.runs.arms import full_names, is_any_trained, require_arms, run_of_arm
from experiments.runs.loops import certificate_of, loop_config
from experiments.runs.output_folder import claim_folder, write_results
from experiments.runs.provenance import experiment_provenance
from experiments.settings import LearningSettings, id_alone
from experiments.terminal import wrapped
from ncs_gym.envs.env import ncs_env
from ncs_gym.validation import counted


@dataclass(frozen=True, kw_only=True)
class SweepSettings(LearningSettings):
    """Compares arms over a grid of channels: how safety, return and interventions depend on the channel.

    Seeds are the same at every point. Leaves episodes.parquet, summary.json, settings.json and the models. Started
    again with the same folder, finished runs are kept. What all channels have in common is given as --channel.

    Attributes:
        out: Output folder.
        seeds: Number of paired training runs per arm and channel.
        arms: Arms of the comparison; see `ncs compare`.
        losses: Loss probabilities of the grid.
        delays: Delays of the grid [steps].
    """

    out: Path = Path("runs/sweep")
    seeds: int = 1
    steps: int | None = 50_000
    episodes: int = 100
    arms: tuple[str, ...] = ("unshielded", "shielded")
    losses: tuple[float, ...] = (0.0, 0.3, 0.6)
    delays: tuple[int, ...] = (0, 2, 4)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("arms", "losses", "delays"):
            side = getattr(self, name)
            if not side or len(set(side)) != len(side):
                raise ValueError(f"--{name} must be different values, at least one")
        for name in ("loss", "delay"):
            if self.channel.get(name) is not None:
                raise ValueError(f"--channel {name} is a side of the grid: give its values there")


def sweep(settings: SweepSettings) -> None:
    """Runs `ncs sweep`."""
    settings = replace(settings, arms=full_names(settings.arms, settings))
    points = [{"loss": loss, "delay": delay} for loss, delay in product(settings.losses, settings.delays)]
    own = settings.between_samples
    loops = [loop_config(settings.env, settings.channel | point, between_samples=own) for point in points]
    require_arms(settings, loops[0], settings.arms)
    certificate = certificate_of(loops[0], settings.certificate, settings.safe_set)  # the contract is the same for all
    claim_folder("sweep", settings.completed)
    if is_any_trained(settings, settings.arms):
        print(*(wrapped(each.agent_line) for each in settings.by_algorithm), sep="\n", flush=True)
    settings = settings.completed
    runs = [
        run_of_arm(settings, loop, certificate, name, index, grid_point=f"loss{point['loss']}-delay{point['delay']}")
        for point, loop in zip(points, loops, strict=True)
        for index in range(settings.seeds)
        for name in settings.arms
    ]
    results = results_of(runs, settings.out, settings)
    per_point = len(runs) // len(points)
    parts = [results[i * per_point : (i + 1) * per_point] for i in range(len(points))]
    common = {"environment": id_alone(settings.env), "algorithm": settings.algorithm}
    cells = [
        point | {"mean_loss": ncs_env(loop.single()).channel.mean_loss, "arms": arm_summaries(part, settings.mode)}
        for point, loop, part in zip(points, loops, parts, strict=True)
    ]
    summary = {"cells": cells} | experiment_provenance(settings, loops[0], certificate, runs)
    files = {}
    for name, table in (("episodes", episodes_table), ("training", training_table)):
        rows = pd.concat(table(part, **common, **point) for part, point in zip(parts, points, strict=True))
        files[f"{name}.parquet"] = parquet(rows, summary)
    certificate.save(settings.out / "certificate.json")
    write_results(settings.out, summary, files)
    print(f"{settings.env}: {counted(settings.seeds, 'run')} per arm and channel\n", sweep_table(cells), sep="\n")
    print(f"files: {settings.out}")
