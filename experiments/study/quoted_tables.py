"""The tables of a study by name, and the pages that quote them between marks."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from experiments.study.study_tables import (
    evaluation_table,
    price_table,
    scores_table,
    simpler_table,
)

# Arms that the short table of the first environment leaves out: they are beside the point or have a twin there.
_NOT_IN_LEAD = ("penalized:1", "shield at test", "psf at test", "K x_hat", "lqr+psf", "lqr+trusting:lookahead")
_NOT_IN_LEAD += ("proportional", "proportional+trusting", "proportional+shielded")
# A mark names a table; what stands between it and the end is replaced.
_MARKED = re.compile(r"(<!-- ncs study: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def budget_text(summary: dict[str, Any]) -> str:
    """Returns what was spent in each environment, one line each."""
    return "\n".join(
        f"{name}: {env['seeds']} {'run' if env['seeds'] == 1 else 'runs'} per arm, {env['steps']:,} training steps "
        f"each, {env['episodes']} episodes per run and condition"
        for name, env in summary["environments"].items()
    )


def _lead(summary: dict[str, Any]) -> dict[str, Any]:
    """Returns the first environment with the arms that a short table has."""
    env = next(iter(summary["environments"].values()))
    arms = {name: arm for name, arm in env["arms"].items() if name not in _NOT_IN_LEAD}
    return env | {"arms": arms, "trained": [name for name in env["trained"] if name in arms]}


_TABLES: dict[str, Callable[[dict[str, Any]], str]] = {
    "lead": lambda summary: evaluation_table(_lead(summary)),
    "budget": budget_text,
    "price": price_table,
    "simpler": simpler_table,
    "scores": scores_table,
}


def tables_by_name(summary: dict[str, Any]) -> dict[str, str]:
    """Returns the tables that pages quote: lead (of the first environment), budget, price, simpler and scores.

    Args:
        summary: What `page_summary` returns, with the sweep of channels.
    """
    return {name: table(summary) for name, table in _TABLES.items()}


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
    if unknown := set(names) - set(_TABLES):
        raise ValueError(f"unknown table {min(unknown)!r} of a study; known are {', '.join(_TABLES)}")
