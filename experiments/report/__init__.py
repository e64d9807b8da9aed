"""The HTML reports of comparisons and sweeps: templates, and what is inserted into them."""

from experiments.report.comparison import comparison_report
from experiments.report.sweep import sweep_report

__all__ = ["comparison_report", "sweep_report"]
