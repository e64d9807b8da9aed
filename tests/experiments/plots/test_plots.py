"""Figures of a comparison: one test per figure and kind of data, of everything that it shows."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex

from agents.results import TrainingPoint
from experiments.analysis.episodes import episodes_table
from experiments.plots import comparison_figures as comparison_module
from experiments.plots.comparison_figures import (
    RATE_WINDOW,
    ShownEpisode,
    comparison_figures,
    most_overridden,
)
from experiments.plots.figure_style import arm_styles, thousands
from tests.experiments.results import ALL_ARMS, history, run, summary_of, trajectory
from tests.plants import random_plant

EPISODE = ShownEpisode(0, "as trained", 0, {"unshielded": trajectory(np.zeros((3, 2)))})


def arms(*names, runs=2, **change):
    return {name: [run(name, index, **change) for index in range(runs)] for name in names}


def scatter_figure(summary):
    return comparison_module.scatter_figure(summary, arm_styles(summary))


def training_figure(shown):
    return comparison_module.training_figure(shown, arm_styles(shown))


def episode_figure(plant, paths):
    """A figure of an episode of arms, given what happened in it by their names."""
    return comparison_module.episode_figure(plant, ShownEpisode(0, "as trained", 0, paths), arm_styles(paths))


def lines(axis):
    return [line for line in axis.get_lines() if len(line.get_xdata()) > 1]


def bands(axis):
    return [artist for artist in axis.collections if isinstance(artist, PolyCollection)]


def texts(figure):
    found = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return found + [tick.get_text() for axis in figure.axes for tick in axis.get_yticklabels()]


def by_color(axis):
    return {to_hex(line.get_color()).lower(): line for line in lines(axis)}


def test_all_arms_look_different_and_two_have_colors_of_their_own():
    looks = arm_styles(ALL_ARMS)
    assert len({(look.color, str(look.dashes)) for look in looks.values()}) == len(ALL_ARMS)
    assert len({(look.marker, str(look.dashes)) for look in looks.values()}) == len(ALL_ARMS)
    two = ["shielded", "unshielded"]
    assert arm_styles(two) == {name: looks[name] for name in two}


def test_training_has_a_line_and_a_band_per_arm_and_interventions_only_of_watching_arms():
    axes = training_figure(arms("unshielded", "monitor", "shielded", runs=3)).axes
    assert [len(lines(axis)) for axis in axes] == [3, 3, 2]
    assert [len(bands(axis)) for axis in axes] == [3, 3, 2]
    styles = arm_styles(["unshielded", "monitor", "shielded"])
    assert set(by_color(axes[2])) == {styles[name].color.lower() for name in ("monitor", "shielded")}
    assert len(training_figure(arms("unshielded", "penalized")).axes) == 2
    figure = training_figure(arms("shielded", runs=3))
    (line,), (band,) = lines(figure.axes[1]), bands(figure.axes[1])
    np.testing.assert_allclose(line.get_xdata(), [0, 10, 20, 100])
    np.testing.assert_allclose(line.get_ydata(), [0, 20, 40, 200])
    assert sorted({y for x, y in band.get_paths()[0].vertices if x == 100}) == [100, 300]
    assert "lowest to the highest run" in figure.caption
    assert thousands(-1234567.5) == "\N{MINUS SIGN}1,234,567.5"


def test_intervention_rate_of_a_training_is_that_of_the_last_steps_only():
    window = RATE_WINDOW
    points = [TrainingPoint(i * window, 0.0, 0, (i > 1) * window // 2) for i in (1, 2, 3)]
    (line,) = lines(training_figure(arms("shielded", runs=1, history=points)).axes[2])
    np.testing.assert_allclose(line.get_ydata()[-3:], [0.0, 50.0, 0.0])


@pytest.mark.parametrize(
    ("names", "pair"),
    [
        (["penalized", "monitor", "unshielded", "shielded:switch", "shielded"], ["unshielded", "shielded"]),
        (["unshielded", "pretrained", "shielded:switch", "pretrained+shielded"], ["pretrained", "pretrained+shielded"]),
        (["monitor", "shielded+penalty"], ["monitor", "shielded+penalty"]),
        (["shielded"], ["shielded"]),
        (["penalized"], ["penalized"]),
    ],
)
def test_time_series_show_the_episode_in_which_most_is_overridden_beside_an_unshielded_arm(names, pair):
    shown = arms(*names)
    busiest = run(names[-1], 1).episodes
    shown[names[-1]][1].scenarios["attacked"] = [busiest[0], replace(busiest[1], interventions=7)]
    table = episodes_table(result for runs in shown.values() for result in runs)
    asked = []

    def path_of(*which):
        asked.append(which)
        return trajectory(np.zeros((3, 2)), intervened=(1,))

    found = most_overridden(table, names, path_of)
    assert found[:3] == (1, "attacked", 1)
    assert [*found.paths] == pair
    assert asked == [(name, 1, "attacked", 1) for name in pair]
    figure = comparison_module.episode_figure(random_plant(1, 2, 1), found, arm_styles(names))
    said = f"episode 1 of run 1 (attacked), where the shield overrides most, {' and '.join(pair)}, with"
    assert said in figure.caption
    assert figure.axes[0].get_title() == "Episode 1 of run 1, attacked"


def test_training_in_which_nothing_happened_has_no_figure(plant):
    nothing = [replace(point, episode_return=np.nan, violation_steps=0, interventions=0) for point in history(64, 128)]
    shown = arms("unshielded", "shielded", history=nothing)
    assert [*comparison_figures(plant, summary_of(shown), shown, EPISODE)] == ["scatter", "episode"]


@pytest.mark.parametrize(("n", "m"), [(2, 1), (4, 2)])
def test_time_series_have_a_panel_for_states_inputs_and_events(n, m):
    plant = random_plant(1, n, m)
    path = trajectory(np.zeros((11, n)), m, intervened=(2, 3), arrivals=(0, 4, 5))
    figure = episode_figure(plant, {"shielded": path})
    assert len(figure.axes) == 2 + m
    for axis in figure.axes[1:-1]:
        (dots,) = [line for line in axis.get_lines() if line.get_marker() == "."]
        np.testing.assert_allclose(dots.get_xdata(), [0.25, 0.35])
        np.testing.assert_allclose(dots.get_ydata(), [1.5, 1.5])
    ticks = [c for c in figure.axes[-1].collections if isinstance(c, LineCollection)]
    assert [len(row.get_segments()) for row in ticks] == [3, 2]
    assert {"packet arrivals, shielded (3)", "interventions, shielded (2)"} <= set(texts(figure))
    assert figure.axes[-1].get_xlabel() == "time [s]"


def test_violations_of_the_limit_are_marked_and_only_then_in_the_legend():
    plant = random_plant(1, 2, 1)
    for reach, marked in ((0.8, False), (1.5, True)):
        path = trajectory(np.linspace(0.0, reach, 11)[:, None] * np.ones(2))
        figure = episode_figure(plant, {"unshielded": path})
        assert any(line.get_marker() == "x" for line in figure.axes[0].get_lines()) is marked
        assert ("violation" in texts(figure)) is marked


def test_scatter_has_a_point_per_run_and_the_mean_with_its_intervals():
    summary = summary_of({"unshielded": [run("unshielded", i, violations=(4, 0)) for i in range(3)]})["arms"]
    (axis,) = scatter_figure(summary).axes
    (dots,) = [line for line in axis.get_lines() if len(line.get_xdata()) == 3]
    assert list(zip(dots.get_xdata(), dots.get_ydata(), strict=True)) == [(50.0, -2.0), (50.0, -3.0), (50.0, -4.0)]
    (mean,) = [line for line in axis.get_lines() if len(line.get_xdata()) == 1]
    assert (mean.get_xdata()[0], mean.get_ydata()[0]) == (50.0, -3.0)
    vertical = [line for line in axis.get_lines() if line.get_marker() == "_"]
    np.testing.assert_allclose(vertical[0].get_ydata(), summary["unshielded"]["eval_return_ci95"])


def test_scatter_without_a_violation_shows_what_the_probability_is_at_most_and_of_one_run_no_interval():
    summary = summary_of(arms("shielded"))["arms"]
    (bar,) = [line for line in scatter_figure(summary).axes[0].get_lines() if line.get_marker() == "|"]
    upper = 100.0 * summary["shielded"]["eval_violation_rate_ci95"][1]
    np.testing.assert_allclose(bar.get_xdata(), [0.0, upper])
    assert upper > 50.0
    figure = scatter_figure(summary_of(arms("shielded", runs=1))["arms"])
    assert not [line for line in figure.axes[0].get_lines() if line.get_marker() == "_"]
    assert figure.axes[0].get_xlim()[1] > 0.5
    assert "no interval" in figure.caption


def test_every_figure_is_a_png_with_a_caption_of_its_own(plant):
    shown = arms(*ALL_ARMS[:2])
    figures = comparison_figures(plant, summary_of(shown), shown, EPISODE)
    assert set(figures) == {"training", "scatter", "episode"}
    assert all(png.startswith(b"\x89PNG") for _, png in figures.values())
    assert len({caption for caption, _ in figures.values()}) == 3
