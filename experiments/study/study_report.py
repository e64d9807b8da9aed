"""The pages of `ncs study`: one in HTML with its figures inside, one in Markdown for the documentation."""

from __future__ import annotations

from typing import Any

from experiments.report.html import render_page
from experiments.study.quoted_tables import budget_text
from experiments.study.study_tables import (
    channels_table,
    evaluation_table,
    overview_table,
    pairs_table,
    price_table,
    scores_table,
    simpler_table,
    training_table,
)


def study_report(summary: dict[str, Any], figures: dict[str, tuple[str, bytes]]) -> str:
    """Returns the HTML page; opens offline, but for its links to the comparisons beside it.

    Args:
        summary: What `page_summary` returns, with the sweep of channels, settings and versions.
        figures: Caption and PNG file by name.
    """
    return render_page("study.html.j2", figures, title="Safe learning: the study", **_context(summary))


def results_page(summary: dict[str, Any], figures: dict[str, tuple[str, bytes]], prefix: str) -> str:
    """Returns the Markdown page.

    Args:
        summary: As for `study_report`.
        figures: As for `study_report`.
        prefix: What stands before a figure's name in its link.
    """
    links = {name: f"{prefix}{name}.png" for name in figures}
    return render_page("results.md.j2", figures, links=links, **_context(summary))


def _context(summary: dict[str, Any]) -> dict[str, Any]:
    """Returns the variables of both templates."""
    environments = summary["environments"]
    return {
        "summary": summary,
        "budget": budget_text(summary),
        "overview": overview_table(summary),
        "evaluation": {name: evaluation_table(env) for name, env in environments.items()},
        "training": {name: training_table(env) for name, env in environments.items()},
        "pairs": {name: pairs_table(env) for name, env in environments.items()},
        "channels": {name: channels_table(rows) for name, rows in summary["channels"].items()},
        "price": price_table(summary),
        "simpler": simpler_table(summary),
        "scores": scores_table(summary),
    }
