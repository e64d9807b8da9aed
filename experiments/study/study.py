"""`ncs study`: the same arms in several environments and under several scenarios, and the pages that tell of it."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pandas as pd

from experiments.analysis.episodes import parquet
from experiments.commands import short_version
from experiments.commands.compare import compare
from experiments.report.html import render_page
from experiments.runs.output_folder import claim_folder, write_results
from experiments.runs.provenance import versions
from experiments.settings import CompareSettings, StudySettings, lasting_settings
from experiments.settings.learning import short_name
from experiments.study.channel_switches import channel_switches, trained_agents
from experiments.study.figures import study_figures
from experiments.study.summary import study_summary
from experiments.study.tables import (
    QUOTABLE,
    agents_of,
    budget_text,
    comparisons_table,
    evaluation_table,
    impairments_table,
    margins_table,
    prices_table,
    switches_table,
    tables_by_name,
    training_table,
)
from experiments.terminal import GREATEST_WIDTH, wrapped
from ncs_gym.reading import read_text
from shields.atomic_write import write_atomically

# Budget of `--smoke`: enough to pass through every part, in the first environment, with baselines of one margin each.
_SMOKE = {"seeds": 2, "budget": 0.01, "episodes": 2, "channel_episodes": 1, "scenarios": ("ideal-channel", "attacked")}
# Folder of the sweep of channels below that of its environment.
_CHANNELS = "channels"


def study(settings: StudySettings) -> None:
    """Runs `ncs study`: prints the table of every environment and writes the files."""
    baselines = tuple(name for name in settings.baselines if ":" not in name)
    settings = short_version(settings, **_SMOKE, envs=settings.envs[:1], baselines=baselines)
    for path in settings.quote:
        require_marks(read_text(path))
    claim_folder("study", settings)
    parts = {short_name(env): _comparison_settings(settings, env) for env in settings.envs}
    episodes, summaries, channels = {}, {}, {}
    for name, part in parts.items():
        episodes[name], summaries[name] = compare(part)
        if settings.channel_episodes:
            sweep = replace(part, out=part.out / _CHANNELS, episodes=settings.channel_episodes)
            channels[name] = channel_switches(sweep, trained_agents(part))
        print(flush=True)
    kept = {key: value for key, value in lasting_settings(settings).items() if key != "smoke"}
    provenance = {"settings": kept, "versions": versions()}
    summary = study_summary(summaries, episodes) | {"channels": channels} | provenance
    _write(settings, summary, pd.concat(episodes, names=["environment"]).reset_index("environment"))
    print(f"files: {settings.out}")


def _comparison_settings(settings: StudySettings, env_id: str) -> CompareSettings:
    names = (vars(settings).keys() & CompareSettings.__dataclass_fields__.keys()) - {"out", "smoke"}
    shared = {name: getattr(settings, name) for name in names}
    part = CompareSettings(env=env_id, out=settings.out / short_name(env_id), tuned_arms=True, **shared)
    return replace(part, steps=math.ceil(settings.budget * part.training_steps))


def _write(settings: StudySettings, summary: dict[str, Any], episodes: pd.DataFrame) -> None:
    figures = study_figures(summary)
    if (page := settings.page) is not None:
        (page.parent / "images").mkdir(parents=True, exist_ok=True)
        for name, (_, png) in figures.items():
            write_atomically(page.parent / "images" / f"{page.stem}-{name}.png", png)
        write_atomically(page.with_suffix(".json"), json.dumps(summary, allow_nan=False) + "\n")
        tables = page.with_suffix(".txt")
        write_atomically(tables, results_tables(summary))
        write_atomically(page, results_page(summary, figures, f"images/{page.stem}-", tables.name))
    files = {
        "episodes.parquet": parquet(episodes, summary),
        "report.html": render_page("study.html.j2", figures, title="Safe learning: the study", **_context(summary)),
        "results.md": results_page(summary, figures, "figures/"),
        "results.txt": results_tables(summary),
    }
    write_results(settings.out, summary, files, figures)
    for path in settings.quote:
        write_atomically(path, quoted(read_text(path), tables_by_name(summary)))


# A mark names a table; what stands between it and the end is replaced.
_MARKED = re.compile(r"(<!-- ncs study: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def results_page(
    summary: dict[str, Any], figures: dict[str, tuple[str, bytes]], prefix: str, tables: str = "results.txt"
) -> str:
    """Returns the Markdown page; figures are linked by their names behind a prefix, `results_tables` by a file."""
    links = {name: f"{prefix}{name}.png" for name in figures}
    return render_page("results.md.j2", figures, links=links, tables=tables, **_context(summary))


def results_tables(summary: dict[str, Any]) -> str:
    """Returns all tables as plain text: every arm and every combination of impairments."""
    known = _context(summary)
    budget = "\n".join(wrapped(line, GREATEST_WIDTH) for line in known["budget"].splitlines())
    parts = [budget, known["comparisons"], known["prices"], known["margins"]]
    for name in summary["environments"]:
        parts.append(f"{name}\n{known['evaluation'][name]}")
        if name in known["channels"]:
            parts.append(f"{name}\n{known['channels'][name]}")
    return "\n\n\n".join([*parts, known["training"]]) + "\n"


def _context(summary: dict[str, Any]) -> dict[str, Any]:
    environments = summary["environments"]
    return {
        "summary": summary,
        "budget": budget_text(summary),
        "comparisons": comparisons_table(summary),
        "prices": prices_table(summary),
        "margins": margins_table(summary),
        "evaluation": {name: evaluation_table(env) for name, env in environments.items()},
        "agents": {name: agents_of(env) for name, env in environments.items()},
        "training": training_table(summary),
        "channels": {name: switches_table(rows) for name, rows in summary["channels"].items()},
        "impairments": impairments_table(summary["channels"]),
    }


def quoted(page: str, tables: Mapping[str, str]) -> str:
    """Returns a page with the tables between its marks replaced.

    A mark is `<!-- ncs study: NAME -->` on a line of its own, and `<!-- end -->` after the table.

    Raises:
        ValueError: If the page has no mark, or one of a table that there is not.
    """
    require_marks(page)
    return _MARKED.sub(lambda found: f"{found[1]}```\n{tables[found[2]]}\n```\n{found[3]}", page)


def require_marks(page: str) -> None:
    """Raises unless a page quotes tables of a study, and none that there is not.

    Raises:
        ValueError: If it does not.
    """
    names = [name for _, name, _ in _MARKED.findall(page)]
    if not names:
        raise ValueError("the page quotes no table of a study: it has no mark <!-- ncs study: NAME -->")
    if unknown := set(names) - set(QUOTABLE):
        raise ValueError(f"unknown table {min(unknown)!r} of a study; known are {', '.join(QUOTABLE)}")
