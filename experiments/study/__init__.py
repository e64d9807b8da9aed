"""From comparisons in several environments to one study: its summary, its sweep of channels, tables, figures, pages."""

from experiments.study.channel_sweep import channel_sweep
from experiments.study.study_summary import page_summary, study_summary

__all__ = ["channel_sweep", "page_summary", "study_summary"]
