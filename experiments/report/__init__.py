"""The reports of comparisons, sweeps and studies: templates, and what is inserted into them."""

from experiments.report.html import comparison_report, sweep_report

__all__ = ["comparison_report", "sweep_report"]
