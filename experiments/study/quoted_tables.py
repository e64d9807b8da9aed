"""The tables of a study by name, and the pages that quote them between marks."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from experiments.study.study_tables import (
    evaluation_table,
    price_table,
    scores_table,
    simpler_table,
)

# A mark names a table; what stands between it and the end is replaced.
_MARKED = re.compile(r"(<!-- ncs study: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def tables_by_name(summary: dict[str, Any]) -> dict[str, str]:
    """Returns the tables that pages quote: lead (of the first environment), budget, price, simpler and scores.

    Args:
        summary: What `page_summary` returns, with the sweep of channels.
    """
    lead = next(iter(summary["environments"].values()))
    return {
        "lead": evaluation_table(lead),
        "budget": budget_text(summary),
        "price": price_table(summary),
        "simpler": simpler_table(summary),
        "scores": scores_table(summary),
    }


def budget_text(summary: dict[str, Any]) -> str:
    """Returns what was spent in each environment, one line each."""
    return "\n".join(
        f"{env['env']}: {env['seeds']} {'run' if env['seeds'] == 1 else 'runs'} per arm, {env['steps']:,} training "
        f"steps per run, {env['episodes']} evaluation episodes per run and condition"
        for env in summary["environments"].values()
    )


def quoted(page: str, tables: Mapping[str, str]) -> str:
    """Returns a page with the tables between its marks replaced.

    A mark is `<!-- ncs study: NAME -->` on a line of its own, and `<!-- end -->` after the table.

    Args:
        page: Text of the page.
        tables: What `tables_by_name` returns.

    Raises:
        ValueError: If the page has no mark, or one of a table that there is not.
    """
    names = [name for _, name, _ in _MARKED.findall(page)]
    if not names:
        raise ValueError("the page quotes no table of a study: it has no mark <!-- ncs study: NAME -->")
    if unknown := set(names) - tables.keys():
        raise ValueError(f"unknown table {sorted(unknown)[0]!r} of a study; known are {', '.join(tables)}")
    return _MARKED.sub(lambda found: f"{found[1]}```\n{tables[found[2]]}\n```\n{found[3]}", page)
