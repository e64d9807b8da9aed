"""One self-contained HTML page: no script, nothing from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping, Sequence
from html import escape

STYLE = """
:root { color-scheme: light; --ink: #1f2933; --soft: #5b6770; --line: #dfe3e6; --wash: #f6f7f8; --accent: #0072b2; }
* { box-sizing: border-box; }
body { font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; color: var(--ink); background: #fff;
  max-width: 68rem; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .35rem; letter-spacing: -.01em; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.75rem 0 .6rem; padding-top: .9rem; border-top: 1px solid var(--line); }
p, li, dd { max-width: 46rem; }
.lead { color: var(--soft); margin: 0 0 1.25rem; max-width: none; }
.note { color: var(--soft); font-size: .875rem; }
ul { padding-left: 1.2rem; } li { margin: .25rem 0; }
dl { display: grid; grid-template-columns: max-content minmax(0, 1fr); gap: .3rem 1.5rem; max-width: 56rem; }
dt { font-weight: 600; } dd { margin: 0; color: var(--soft); }
.scroll { overflow-x: auto; margin: .75rem 0; }
table { border-collapse: collapse; font-size: .84rem; line-height: 1.35; font-variant-numeric: tabular-nums; }
th, td { padding: .45rem .65rem; border-bottom: 1px solid var(--line); text-align: right; vertical-align: bottom; }
th { min-width: 5rem; font-weight: 600; color: var(--soft); border-bottom: 2px solid var(--ink); }
td { white-space: nowrap; vertical-align: top; }
th:first-child, td:first-child { text-align: left; padding-left: 0; position: sticky; left: 0; background: #fff; }
tr.rule td { border-top: 2px solid #b9c0c5; }
table.words td { text-align: left; position: static !important; white-space: normal;
  overflow-wrap: anywhere; }
wbr { display: none; }
.interval { color: var(--soft); display: block; font-size: .92em; }
.list { display: inline-block; min-width: 8rem; white-space: normal; }
.swatch { display: inline-block; width: .7em; height: .7em; border-radius: 50%; margin-right: .5em; }
.whole { white-space: nowrap; }
.holds { color: #14713f; } .broken { color: #b3261e; font-weight: 700; }
figure { margin: 1.5rem 0 2.25rem; }
figcaption { font-size: .875rem; color: var(--soft); max-width: 52rem; margin-top: .4rem; }
img { display: block; height: auto; max-width: 100%; }
code, pre { font: .84rem/1.5 ui-monospace, "SF Mono", Menlo, Consolas, monospace; }
code { background: var(--wash); padding: .1em .3em; border-radius: 3px; overflow-wrap: anywhere; }
pre { background: var(--wash); padding: .9rem 1rem; border-radius: 4px; overflow-x: auto; }
.columns { columns: 2 24rem; column-gap: 2.5rem; } .columns table { width: 100%;
  border-collapse: separate; border-spacing: 0; } .columns tr { break-inside: avoid; }
@media (max-width: 40rem) {
  wbr { display: inline; }
  body { padding: 1.25rem 1rem 3rem; font-size: 15px; } h1 { font-size: 1.4rem; }
  dl { display: block; } dd { margin-bottom: .5rem; }
  tbody td:first-child { white-space: normal; min-width: 7rem; max-width: 9rem; }
  figure .scroll img { max-width: 44rem; }
}
@media print {
  wbr { display: inline; }
  @page { margin: 14mm; } html { font-size: 11px; } body { max-width: none; padding: 0; font-size: 1rem; }
  h2 { break-after: avoid; } figure, tr { break-inside: avoid; } .scroll { overflow: visible; }
  th, td { padding: .3rem .4rem; min-width: 0; } .whole, pre { white-space: pre-wrap; } .list { min-width: 5rem; }
  td:first-child, th:first-child { position: static; } tbody td:first-child { white-space: normal; }
}
"""


# Pixels of a figure per pixel of the page: the widest figures then fill it, and letters are alike in all.
DENSITY = 1.36
WIDTH_IN_PNG = slice(16, 20)
# More names and values than these stand in columns.
MANY = 8


class Markup(str):
    """Text that is HTML already; any other is escaped."""


def page(title: str, lead: str, sections: Mapping[str, str]) -> str:
    """Returns the page.

    Args:
        title: Plain text.
        lead: A line under the title, plain text.
        sections: HTML by heading; headings are plain text, an empty one has none. Empty sections are left out.
    """
    body = "\n".join(
        f"<section>{f'<h2>{escape(heading)}</h2>' if heading else ''}\n{content}</section>"
        for heading, content in sections.items()
        if content
    )
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title><style>{STYLE}</style></head><body>
<h1>{escape(title)}</h1>
<p class="lead">{escape(lead)}</p>
{body}
</body></html>
"""


def table(name: str, head: Sequence[str], rows: Sequence[Sequence[str]], rules: Collection[int] = ()) -> str:
    """Returns a table that scrolls where it is too wide.

    Args:
        name: For readers who hear it.
        head: Cells; `Markup` stays as it is.
        rows: Rows of such cells.
        rules: Numbers of the rows above which a line is drawn.
    """
    heads = "".join(f'<th scope="col">{_html(cell)}</th>' for cell in head)
    body = "\n".join(
        f"<tr{' class=rule' if i in rules else ''}>{''.join(f'<td>{_html(cell)}</td>' for cell in row)}</tr>"
        for i, row in enumerate(rows)
    )
    return (
        f'<div class="scroll" role="region" aria-label="{escape(name)}" tabindex="0"><table><thead><tr>{heads}</tr>'
        f"</thead><tbody>\n{body}\n</tbody></table></div>\n"
    )


def pairs(values: Mapping[str, str]) -> str:
    """Returns names and values, in columns where there are many."""
    body = "\n".join(f"<tr><td>{_html(name)}</td><td>{_html(value)}</td></tr>" for name, value in values.items())
    columns = "columns" if len(values) > MANY else "scroll"
    return f'<div class="{columns}"><table class="words"><tbody>\n{body}\n</tbody></table></div>\n'


def figure(caption: str, png: bytes) -> str:
    """Returns an image with its caption; its first sentence stands for it where it is not seen."""
    data = base64.b64encode(png).decode()
    width = round(int.from_bytes(png[WIDTH_IN_PNG]) / DENSITY)
    return (
        f'<figure><div class="scroll" role="region" aria-label="figure" tabindex="0">'
        f'<img alt="{escape(caption.partition(". ")[0])}" width="{width}" src="data:image/png;base64,{data}"></div>'
        f"<figcaption>{escape(caption)}</figcaption></figure>\n"
    )


def items(lines: Sequence[str]) -> str:
    """Returns a list of sentences; none without any."""
    return f"<ul>{''.join(f'<li>{_html(line)}</li>' for line in lines)}</ul>\n" if lines else ""


def note(text: str) -> str:
    """Returns a paragraph about what stands above it."""
    return f'<p class="note">{_html(text)}</p>\n'


def _html(text: str) -> str:
    return str(text) if isinstance(text, Markup) else escape(text)
