"""Figures of comparisons and sweeps, and animations of episodes."""

from experiments.plots.comparison_figures import comparison_figures
from experiments.plots.figure_style import ArmStyle
from experiments.plots.heatmaps import sweep_figures

__all__ = ["ArmStyle", "comparison_figures", "sweep_figures"]
