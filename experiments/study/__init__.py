"""`ncs study`: comparisons in several environments become one summary, with tables, figures and pages."""

from experiments.study.study import study

__all__ = ["study"]
