"""One self-contained page about a comparison."""

from __future__ import annotations

import base64
import json
from html import escape
from typing import Any

from experiments.summary import table_rows
from shields import Report

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .7rem; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; } td { white-space: nowrap; }
figure { margin: 1.5rem 0; } figcaption { font-size: .9rem; color: #555; }
img { max-width: 100%; } code, pre { font-size: .8rem; } pre { background: #f6f6f6; padding: 1rem; overflow-x: auto; }
.holds { color: #14713f; } .broken { color: #b3261e; font-weight: bold; }
"""

EXPLANATION = """The same task learned by PPO twice: <b>unshielded</b>, where the agent's action is applied, and
<b>shielded</b>, where an action that could drive the state out of the safe set is replaced (mode {mode}). Runs with
equal numbers meet the same initial states, disturbances and packet losses. Below the arms stand policies for reference,
without training and without a shield. Violations are those of the true state, which neither agent nor shield sees.
Intervals of the return are over runs for learned policies and over episodes for fixed ones."""


def html_report(summary: dict[str, Any], verification: Report, figures: dict[str, bytes], findings: list[str]) -> str:
    """Returns the page: result table, findings, figures, certificate and settings; opens offline.

    Args:
        summary: The content of summary.json.
        verification: Of the certificate.
        figures: PNG bytes by caption.
        findings: Sentences to print under the table.
    """
    settings = summary["settings"]
    title = f"Shielded and unshielded PPO on {settings['env']}"
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style></head><body>
<h1>{escape(title)}</h1>
<p>{EXPLANATION.format(mode=escape(settings["mode"]))}</p>
{_table(table_rows(summary["arms"] | summary["references"]))}
<ul>{"".join(f"<li>{escape(line)}</li>" for line in findings)}</ul>
{_images(figures)}
{_provenance(summary, verification)}
</body></html>
"""


def sweep_report(summary: dict[str, Any], verification: Report, figures: dict[str, bytes]) -> str:
    """Returns the page of a sweep; see `html_report`."""
    title = f"Channels of {summary['settings']['env']}"
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style></head><body>
<h1>{escape(title)}</h1>
<p>Agents trained and evaluated anew for every channel, with the same seeds. Violations are those of the true state.</p>
{_images(figures)}
{_provenance(summary, verification)}
</body></html>
"""


def _images(figures: dict[str, bytes]) -> str:
    return "".join(
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
        for caption, png in figures.items()
    )


def _provenance(summary: dict[str, Any], verification: Report) -> str:
    content = {name: summary[name] for name in ("settings", "plant", "certificate", "versions")}
    return f"""<h2>The certificate, verified in exact rational arithmetic</h2>
{_conditions(verification)}
<h2>Settings and versions</h2>
<pre>{escape(json.dumps(content, indent=1))}</pre>"""


def _table(rows: list[list[str]]) -> str:
    head = "".join(f"<th>{escape((top + ' ' + low).strip())}</th>" for top, low in zip(rows[0], rows[1], strict=True))
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows[2:])
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _conditions(verification: Report) -> str:
    rows = "".join(
        f"<tr><td>{escape(c.name)}</td><td>{c.margin:+.2e}</td>"
        f'<td class="{"holds" if c.holds else "broken"}">{"holds" if c.holds else "broken"}</td></tr>'
        for c in verification.conditions
    )
    return f"<table><thead><tr><th>condition</th><th>margin</th><th></th></tr></thead><tbody>{rows}</tbody></table>"
