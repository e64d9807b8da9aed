"""`ncs study`: the same arms in several environments and under several scenarios, and what can be concluded."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.analysis.episodes import parquet
from experiments.commands import short_version
from experiments.commands.compare import compare
from experiments.runs import claim_folder, prepare_output, versions, write_results
from experiments.runs.experiment import INCIDENTAL_SETTINGS
from experiments.settings import BackendSettings, CompareSettings, StudySettings, settings_json
from experiments.settings.study import short_name
from experiments.study.channel_switches import channel_switches, trained_agents
from experiments.study.figures import study_figures
from experiments.study.pages import quoted, require_marks, results_page, results_tables, study_report
from experiments.study.summary import study_summary
from experiments.study.tables import tables_by_name
from shields.atomic_write import write_atomically

# Budget of `--smoke`: enough to pass through every part.
_SMOKE = {"seeds": 2, "budget": 0.01, "episodes": 4, "channel_episodes": 1}
# Folder of the sweep of channels below that of its environment, and settings that say nothing of results.
_CHANNELS, _INCIDENTAL = "channels", (*INCIDENTAL_SETTINGS, "smoke")


def study(settings: StudySettings) -> None:
    """Runs `ncs study`: prints the table of every environment and writes the files.

    Raises:
        ValueError: If a setting is out of range, a page quotes no table, or a stored result is damaged.
        FolderInUseError: If another command is writing to the output folder.
        OtherResultsError: If the output folder holds finished results of other settings.
        OSError: If a file cannot be read or written.
        Infeasible: If no certificate is found.
        RunError: If a run fails.
        ClusterError: If a cluster cannot execute the runs.
    """
    settings = short_version(settings, **_SMOKE)
    for path in settings.quote:
        require_marks(path.read_text("utf-8"))
    with claim_folder("study", settings):
        _study_in_folder(settings)


def _study_in_folder(settings: StudySettings) -> None:
    """Executes what is missing, prints the tables and writes the files."""
    prepare_output(settings.out)
    parts = {short_name(env): _comparison_settings(settings, env) for env in settings.envs}
    comparisons, channels = {}, {}
    for name, part in parts.items():
        compare(part)
        comparisons[name] = json.loads((part.out / "summary.json").read_bytes())
        if settings.channel_episodes:
            sweep = replace(part, out=part.out / _CHANNELS, episodes=settings.channel_episodes)
            channels[name] = channel_switches(sweep, trained_agents(part))
        print(flush=True)
    content = settings_json("study", settings)["settings"]
    provenance = {
        "settings": {key: value for key, value in content.items() if key not in _INCIDENTAL},
        "versions": versions(),
    }
    episodes = {name: pd.read_parquet(part.out / "episodes.parquet") for name, part in parts.items()}
    summary = study_summary(comparisons, episodes) | {"channels": channels} | provenance
    _write(settings, summary, pd.concat(episodes, names=["environment"]).reset_index("environment"))
    print(f"files: {settings.out}")


def _comparison_settings(settings: StudySettings, env_id: str) -> CompareSettings:
    """Returns the settings of the comparison in an environment."""
    backend = {name: getattr(settings, name) for name in BackendSettings.__dataclass_fields__}
    part = CompareSettings(
        env=env_id,
        out=settings.out / short_name(env_id),
        seed=settings.seed,
        seeds=settings.seeds,
        episodes=settings.episodes,
        algo=settings.algo,
        arms=settings.arms,
        baselines=settings.baselines,
        scenarios=settings.scenarios,
        safe_set=settings.safe_set,
        force=settings.force,
        **backend,
    )
    return replace(part, steps=math.ceil(settings.budget * part.training_steps))


def _write(settings: StudySettings, summary: dict[str, Any], episodes: pd.DataFrame) -> None:
    """Writes every file."""
    figures = study_figures(summary)
    if settings.page is not None:
        _write_page(settings.page, summary, figures)
    files = {
        "episodes.parquet": parquet(episodes, summary),
        "report.html": study_report(summary, figures),
        "results.md": results_page(summary, figures, "figures/"),
        "results.txt": results_tables(summary),
    }
    write_results(settings.out, summary, files, figures)
    for path in settings.quote:
        write_atomically(path, quoted(path.read_text("utf-8"), tables_by_name(summary)))


def _write_page(page: Path, summary: dict[str, Any], figures: dict[str, tuple[str, bytes]]) -> None:
    """Writes the page of the documentation, its figures, all tables, and the numbers that they show."""
    images = page.parent / "images"
    images.mkdir(parents=True, exist_ok=True)
    for name, (_, png) in figures.items():
        write_atomically(images / f"{page.stem}-{name}.png", png)
    write_atomically(page.with_suffix(".json"), json.dumps(summary, allow_nan=False) + "\n")
    tables = page.with_suffix(".txt")
    write_atomically(tables, results_tables(summary))
    write_atomically(page, results_page(summary, figures, f"images/{page.stem}-", tables.name))
