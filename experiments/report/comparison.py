"""The report of `ncs compare`."""

from __future__ import annotations

from typing import Any

from experiments.report.html import render_report
from shields import Report


def comparison_report(
    summary: dict[str, Any], verification: Report, figures: dict[str, bytes], findings: list[str]
) -> str:
    """Returns the page: tables, findings, figures, certificate and settings; opens offline.

    Args:
        summary: Content of summary.json.
        verification: Exact verification of the certificate.
        figures: PNG files by caption.
        findings: Sentences to print under the first table.
    """
    return render_report(
        "comparison.html.j2",
        f"Safe learning on {summary['settings']['env']}",
        "compare",
        summary,
        verification,
        figures,
        runs=max(arm["runs"] for arm in summary["arms"].values()),
        findings=findings,
    )
