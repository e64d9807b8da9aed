"""From evaluation episodes to confidence intervals, summaries of arms, and tables."""

from experiments.analysis.arm_table import condition_text, summary_text
from experiments.analysis.statistics import bootstrap_interval, clopper_pearson, interquartile_mean, mean_interval
from experiments.analysis.summary import arm_summary, paired_differences, summarize_arm
from experiments.analysis.text_table import text_table

__all__ = [
    "arm_summary",
    "bootstrap_interval",
    "clopper_pearson",
    "condition_text",
    "interquartile_mean",
    "mean_interval",
    "paired_differences",
    "summarize_arm",
    "summary_text",
    "text_table",
]
