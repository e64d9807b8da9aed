"""The report of `ncs sweep`."""

from __future__ import annotations

from typing import Any

from experiments.report.html import render_report
from shields import Report


def sweep_report(summary: dict[str, Any], verification: Report, figures: dict[str, bytes]) -> str:
    """Returns the page: figures, a table of every channel and arm, certificate and settings; opens offline.

    Args:
        summary: Content of summary.json.
        verification: Exact verification of the certificate.
        figures: PNG files by caption.
    """
    title = f"Channels of {summary['settings']['env']}"
    return render_report("sweep.html.j2", title, "sweep", summary, verification, figures)
