"""The pages of `ncs study`: in HTML with its figures inside, in Markdown, as tables alone, and others that quote it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from experiments.report.html import render_page
from experiments.study.tables import (
    QUOTABLE,
    agents_of,
    budget_text,
    comparisons_table,
    evaluation_table,
    margins_table,
    prices_table,
    switches_table,
    training_table,
)

# A mark names a table; what stands between it and the end is replaced.
_MARKED = re.compile(r"(<!-- ncs study: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def study_report(summary: dict[str, Any], figures: dict[str, tuple[str, bytes]]) -> str:
    """Returns the HTML page; opens offline, but for its links to the comparisons beside it.

    Args:
        summary: What `study_summary` returns, with the sweep of channels, settings and versions.
        figures: Caption and PNG file by name.
    """
    return render_page("study.html.j2", figures, title="Safe learning: the study", **_context(summary))


def results_page(
    summary: dict[str, Any], figures: dict[str, tuple[str, bytes]], prefix: str, tables: str = "results.txt"
) -> str:
    """Returns the Markdown page.

    Args:
        summary: As for `study_report`.
        figures: As for `study_report`.
        prefix: What stands before a figure's name in its link.
        tables: Link to the file of all tables (`results_tables`).
    """
    links = {name: f"{prefix}{name}.png" for name in figures}
    return render_page("results.md.j2", figures, links=links, tables=tables, **_context(summary))


def results_tables(summary: dict[str, Any]) -> str:
    """Returns all tables as plain text: every arm and every combination of impairments.

    Args:
        summary: As for `study_report`.
    """
    known = _context(summary)
    parts = [known["budget"], known["comparisons"], known["prices"], known["margins"]]
    for name in summary["environments"]:
        parts.append(f"{name}\n{known['evaluation'][name]}")
        if name in known["channels"]:
            parts.append(f"{name}\n{known['channels'][name]}")
    return "\n\n\n".join([*parts, known["training"]]) + "\n"


def _context(summary: dict[str, Any]) -> dict[str, Any]:
    """Returns the variables of both templates."""
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
        "switches": {name: switches_table(rows, combined=False) for name, rows in summary["channels"].items()},
    }


def quoted(page: str, tables: Mapping[str, str]) -> str:
    """Returns a page with the tables between its marks replaced.

    A mark is `<!-- ncs study: NAME -->` on a line of its own, and `<!-- end -->` after the table.

    Args:
        page: Text of the page.
        tables: What `tables_by_name` returns.

    Raises:
        ValueError: If the page has no mark, or one of a table that there is not.
    """
    require_marks(page)
    return _MARKED.sub(lambda found: f"{found[1]}```\n{tables[found[2]]}\n```\n{found[3]}", page)


def require_marks(page: str) -> None:
    """Returns if a page quotes tables of a study, and none that there is not.

    Raises:
        ValueError: If it does not.
    """
    names = [name for _, name, _ in _MARKED.findall(page)]
    if not names:
        raise ValueError("the page quotes no table of a study: it has no mark <!-- ncs study: NAME -->")
    if unknown := set(names) - set(QUOTABLE):
        raise ValueError(f"unknown table {min(unknown)!r} of a study; known are {', '.join(QUOTABLE)}")
