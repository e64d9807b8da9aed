"""The reports of comparisons, sweeps and studies: templates, and what is inserted into them."""

from experiments.report.comparison import comparison_report
from experiments.report.sweep import sweep_report

__all__ = ["comparison_report", "sweep_report"]
