"""Figures of a comparison: one test per figure and kind of data, of everything that it shows."""

from dataclasses import replace

import numpy as np
from matplotlib.collections import PolyCollection

from experiments import figures
from experiments.figures import arm_styles, comparison_figures
from tests.experiments.results import history, run, summary_of


def arms(*names, runs=2, **change):
    return {name: [run(name, index, **change) for index in range(runs)] for name in names}


def scatter_figure(summary):
    return figures.scatter_figure(summary, arm_styles(summary))


def training_figure(shown):
    return figures.training_figure(shown, arm_styles(shown))


def lines(axis):
    return [line for line in axis.get_lines() if len(line.get_xdata()) > 1]


def bands(axis):
    return [artist for artist in axis.collections if isinstance(artist, PolyCollection)]


def test_training_has_a_line_and_a_band_per_arm_and_interventions_only_of_watching_arms():
    axes = training_figure(arms("unshielded", "monitor", "shielded", runs=3)).axes
    assert [len(lines(axis)) for axis in axes] == [len(bands(axis)) for axis in axes] == [3, 3, 2]
    assert len(training_figure(arms("unshielded", "penalized")).axes) == 2
    figure = training_figure(arms("shielded", runs=3))
    (line,), (band,) = lines(figure.axes[1]), bands(figure.axes[1])
    np.testing.assert_allclose(line.get_xdata(), [0, 10, 20, 100])
    np.testing.assert_allclose(line.get_ydata(), [0, 20, 40, 200])
    assert sorted({y for x, y in band.get_paths()[0].vertices if x == 100}) == [100, 300]


def test_training_in_which_nothing_happened_has_no_figure():
    nothing = [replace(point, episode_return=np.nan, violation_steps=0, interventions=0) for point in history(64, 128)]
    shown = arms("unshielded", "shielded", history=nothing)
    assert [*comparison_figures(summary_of(shown), shown)] == ["scatter"]


def test_scatter_without_a_violation_shows_what_the_probability_is_at_most_and_of_one_run_no_interval():
    summary = summary_of(arms("shielded"))["arms"]
    (bar,) = [line for line in scatter_figure(summary).axes[0].get_lines() if line.get_marker() == "|"]
    upper = 100.0 * summary["shielded"]["eval_violation_rate_ci95"][1]
    np.testing.assert_allclose(bar.get_xdata(), [0.0, upper])
    assert upper > 50.0
    figure = scatter_figure(summary_of(arms("shielded", runs=1))["arms"])
    assert not [line for line in figure.axes[0].get_lines() if line.get_marker() == "_"]
