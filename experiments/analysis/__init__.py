"""From evaluation episodes to confidence intervals, summaries of arms, and tables."""

from experiments.analysis.arm_table import condition_text, summary_text
from experiments.analysis.paired_tests import all_pairs, holm, paired_difference
from experiments.analysis.statistics import (
    bootstrap_interval,
    clopper_pearson,
    interquartile_mean,
    mean_interval,
    stratified_interval,
)
from experiments.analysis.summary import arm_summary, paired_differences, summarize_arm
from experiments.analysis.terminal_text import text_table

__all__ = [
    "all_pairs",
    "arm_summary",
    "bootstrap_interval",
    "clopper_pearson",
    "condition_text",
    "holm",
    "interquartile_mean",
    "mean_interval",
    "paired_difference",
    "paired_differences",
    "stratified_interval",
    "summarize_arm",
    "summary_text",
    "text_table",
]
