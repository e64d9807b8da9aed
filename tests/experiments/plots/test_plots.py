"""Figures of a comparison: one test per figure and kind of data, of everything that it shows."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgb
from scipy.optimize import linprog

from agents.results import TrainingPoint
from experiments.baselines import CONTROLLERS, FILTERS, REGULATORS
from experiments.network_loop.log import StepLog
from experiments.plots import comparison_figures as figures
from experiments.plots.comparison_figures import (
    RATE_WINDOW,
    comparison_figures,
    episode_figure,
    phase_figure,
    projected_box,
    projected_ellipsoid,
    scatter_figure,
    training_figure,
)
from experiments.plots.figure_style import ARM_COLORS_AND_MARKERS, ArmStyle, thousands
from experiments.plots.loop_figure import loop_log_figure
from ncs_gym import Ellipsoid, LinearPlant
from shields.polytope import Polytope
from tests.command import without_pictures
from tests.experiments.results import ALL_ARMS, history, run, summary_of, trajectory
from tests.plants import random_plant

# Linear approximations of how the two common kinds of color blindness see (Machado, Oliveira and Fernandes 2009).
DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]]
)
PROTANOPIA = np.array(
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
)


def arms(*names, runs=2, **change):
    return {name: [run(name, index, **change) for index in range(runs)] for name in names}


def lines(axis):
    return [line for line in axis.get_lines() if len(line.get_xdata()) > 1]


def bands(axis):
    return [artist for artist in axis.collections if isinstance(artist, PolyCollection)]


def texts(figure):
    found = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return found + [tick.get_text() for axis in figure.axes for tick in axis.get_yticklabels()]


def by_color(axis):
    return {to_hex(line.get_color()).lower(): line for line in lines(axis)}


def keeping(L):
    """What figures take of a certificate of an ellipsoid."""
    return SimpleNamespace(L=L, polytope=None, safe_set=Ellipsoid(L))


BALL = keeping(np.eye(2))


def test_all_arms_look_different_and_a_penalty_keeps_the_color():
    policies = (*CONTROLLERS, *REGULATORS, "untrained", "pretrained")
    assert all(ArmStyle.of(f"{policy}{each}").marker for policy in policies for each in ("", "+shielded", "+psf:tube"))
    assert all(ArmStyle.of(f"{each}{kind}").marker for each in FILTERS for kind in ("", "+penalty", " at test"))
    looks = [ArmStyle.of(arm) for arm in ALL_ARMS]
    assert len({(look.color, str(look.dashes)) for look in looks}) == len(ALL_ARMS)
    assert len({(look.marker, look.hollow) for look in looks}) == len(ALL_ARMS)
    assert ArmStyle.of("shielded:switch+penalty").color == ArmStyle.of("shielded:switch").color


def test_markers_tell_a_price_apart_and_filters_of_a_fixed_policy():
    assert ArmStyle.of("penalized").size != ArmStyle.of("penalized:10").size
    policies = [ArmStyle.of(f"lqr+{name}") for name in ("trusting", "psf:tube", "shielded", "lookahead")]
    assert len({(style.color, style.hollow) for style in policies}) == len(policies)


@pytest.mark.parametrize("seen", [np.eye(3), DEUTERANOPIA, PROTANOPIA])
def test_color_blind_readers_can_tell_the_colors_apart(seen):
    linear = {arm: np.power(to_rgb(color), 2.2) for arm, (color, _) in ARM_COLORS_AND_MARKERS.items()}
    shown = {arm: np.power(np.clip(seen @ color, 0.0, 1.0), 1 / 2.2) for arm, color in linear.items()}
    for one, other in combinations(shown, 2):
        assert np.linalg.norm(shown[one] - shown[other]) > 0.1, (one, other)


def test_arms_have_the_same_color_in_every_figure(plant):
    shown = arms("unshielded", "shielded:boundary")
    training = training_figure(shown).axes[0]
    scatter = scatter_figure(summary_of(shown)["arms"]).axes[0]
    phase = phase_figure(plant, BALL, shown)
    wanted = {ArmStyle.of(name).color.lower() for name in shown}
    assert set(by_color(training)) == wanted
    assert {to_hex(line.get_markeredgecolor()).lower() for line in scatter.get_lines()} >= wanted
    for name, axis in zip(shown, phase.axes, strict=True):
        assert ArmStyle.of(name).color.lower() in by_color(axis)


def test_legend_takes_rows_until_it_fits_the_figure(plant):
    figure = training_figure(arms(*ALL_ARMS))
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert len(figure.legends[0].get_texts()) == len(ALL_ARMS) + 1
    assert box.x0 >= 0.0
    assert box.x1 <= figure.bbox.x1


def test_training_has_a_line_and_a_band_per_arm_and_interventions_only_of_watching_arms():
    axes = training_figure(arms("unshielded", "monitor", "shielded", runs=3)).axes
    assert [len(lines(axis)) for axis in axes] == [3, 3, 2]
    assert [len(bands(axis)) for axis in axes] == [3, 3, 2]
    assert set(by_color(axes[2])) == {ArmStyle.of(name).color.lower() for name in ("monitor", "shielded")}
    unwatched = training_figure(arms("unshielded", "penalized"))
    assert len(unwatched.axes) == 2
    assert "Interventions" not in unwatched.caption
    figure = training_figure(arms("shielded", runs=3))
    (line,), (band,) = lines(figure.axes[1]), bands(figure.axes[1])
    np.testing.assert_allclose(line.get_xdata(), [0, 10, 20, 100])
    np.testing.assert_allclose(line.get_ydata(), [0, 20, 40, 200])
    assert sorted({y for x, y in band.get_paths()[0].vertices if x == 100}) == [100, 300]
    assert "lowest to the highest run" in figure.caption
    assert thousands(-1234567.5) == "\N{MINUS SIGN}1,234,567.5"


def test_training_of_one_run_has_no_band_and_the_caption_says_so():
    figure = training_figure(arms("unshielded", "shielded", runs=1))
    assert [bands(axis) for axis in figure.axes] == [[], [], []]
    assert "no band" in figure.caption
    assert not any("run" in text for text in texts(figure))


def test_training_of_one_point_is_seen_and_an_unfinished_episode_is_said():
    for axis in training_figure(arms("shielded", history=history(64))).axes:
        (line,) = axis.get_lines()
        assert line.get_marker() == "^"
        assert 64 in line.get_xdata()
        low, high = axis.get_ylim()
        assert low < line.get_ydata()[-1] < high
    unfinished = [replace(point, episode_return=float("nan")) for point in history(64)]
    axis = training_figure(arms("shielded", history=unfinished)).axes[0]
    assert [text.get_text() for text in axis.texts] == ["no episode was finished"]


def test_intervention_rate_of_a_training_is_that_of_the_last_steps_only():
    window = RATE_WINDOW
    points = [TrainingPoint(i * window, 0.0, 0, (i > 1) * window // 2) for i in (1, 2, 3)]
    (line,) = lines(training_figure(arms("shielded", runs=1, history=points)).axes[2])
    np.testing.assert_allclose(line.get_ydata()[-3:], [0.0, 50.0, 0.0])


def test_caption_of_a_training_names_the_arms_whose_return_contains_penalties_and_what_a_monitor_counts():
    caption = training_figure(arms("penalized", "shielded+penalty", "shielded", "monitor")).caption
    assert "penalties that penalized and shielded+penalty get" in caption
    assert "would have" in caption
    assert "penalties" not in training_figure(arms("unshielded", "shielded")).caption


def test_phase_plane_has_a_panel_per_arm_a_path_per_run_and_marks_violations(plant):
    states = np.linspace(0.0, 2.5, 6)[:, None] * [1.0, 0.0]  # the box ends at 2: one state violates
    shown = arms("unshielded", "shielded", runs=3, trajectory=trajectory(states))
    figure = phase_figure(plant, BALL, shown)
    assert len(figure.axes) == 2
    for axis, name in zip(figure.axes, shown, strict=True):
        own = [line for line in lines(axis) if to_hex(line.get_color()).lower() == ArmStyle.of(name).color.lower()]
        assert len(own) == 3
        crosses = [line for line in axis.get_lines() if line.get_marker() == "x"]
        assert [line.get_xdata().tolist() for line in crosses] == [[2.5]] * 3
    assert figure.axes[0].get_xlabel() == "coupling stretch [m]"
    assert figure.axes[0].get_ylabel() == "stretch rate [m/s]"


def test_view_holds_the_sets_and_leaves_out_what_is_far_away(plant):
    far = trajectory(np.array([[0.0, 0.0], [1e3, 0.0]]))
    figure = phase_figure(plant, BALL, arms("unshielded", trajectory=far))
    low, high = figure.axes[0].get_xlim()
    assert 2.0 < high < 10.0
    assert low == -high
    assert "leave the view" in figure.caption


def test_of_many_states_the_largest_are_shown_and_the_caption_speaks_of_projections():
    states = np.array([[0.0, 0.1, 0.0, 0.1], [0.1, 0.9, 0.2, 0.3]])
    certificate = keeping(np.diag([1.0, 1, 1, 0.1]))
    figure = phase_figure(random_plant(0, 4, 1), certificate, arms("shielded", trajectory=trajectory(states)))
    assert "x2 and x4" in figure.caption
    assert "projection" in figure.caption
    assert any("projection of the safe set" in text for text in texts(figure))


def test_phase_plane_draws_the_set_that_the_shield_keeps_and_chooses_states_by_it():
    """The ellipsoid inside is small and long in other directions: neither outline nor choice is its."""
    polytope = Polytope(rows=np.diag([0.5, 0.5, 10.0]), multipliers=np.zeros((4, 3)))
    certificate = SimpleNamespace(L=np.diag([0.01, 1.0, 1e-4]), polytope=polytope, safe_set=polytope)
    states = np.array([[0.0, 0.0, 0.0], [1.5, 1.0, 0.09]])
    plant = random_plant(0, 3, 1)
    figure = phase_figure(plant, certificate, arms("shielded", trajectory=trajectory(states)))
    assert "x1 and x3" in figure.caption
    drawn = [line.get_xydata() for line in figure.axes[0].get_lines() if line.get_linestyle() == "-"]
    assert any(np.allclose(np.abs(points).max(axis=0), [2.0, 0.1]) for points in drawn)
    shifted = np.array([[10.0, 0.0, 0.0], [10.5, 0.4, 0.05]])  # close to the middle of a set elsewhere
    moved = SimpleNamespace(L=certificate.L, polytope=None, safe_set=_Moved(np.array([10.0, 0.0, 0.0])))
    assert figures.plane_of(moved, shifted, 3) == (1, 2)
    assert figures.plane_of(moved, shifted, 2) == (0, 1)  # the third is a past input


class _Moved:
    """A box around another point, with half-widths 2, 1 and 0.1."""

    def __init__(self, center):
        self.center = center

    def support(self, directions):
        return directions @ self.center + np.abs(directions) @ np.array([2.0, 1.0, 0.1])


@pytest.mark.parametrize("seed", range(3))
def test_projections_reach_as_far_as_the_sets_in_every_direction(seed):
    rng = np.random.default_rng(seed)
    factor, rows, ends = rng.standard_normal((4, 4)), rng.standard_normal((5, 4)), rng.uniform(0.2, 2.0, (2, 5))
    ellipse = projected_ellipsoid(factor @ factor.T, (0, 2), 20_001)
    box = projected_box(rows, ends * [[-1.0], [1.0]], (0, 2))
    for angle in np.linspace(0.0, np.pi, 7):
        direction = np.array([np.cos(angle), 0.0, np.sin(angle), 0.0])
        reach = linprog(-direction, np.vstack([-rows, rows]), ends.ravel(), bounds=(None, None))
        assert (box @ direction[[0, 2]]).max() == pytest.approx(-reach.fun)
        wanted = Ellipsoid(factor @ factor.T).support(direction)
        assert (ellipse @ direction[[0, 2]]).max() == pytest.approx(wanted, rel=1e-5)


def test_box_without_limits_in_the_plane_has_no_outline_and_elsewhere_does_not_matter():
    rows = np.array([[0.5, 0.0, 0.0], [0.0, 0.25, 0.0]])
    ends = np.array([[-1.0, -0.5], [1.0, 1.5]])
    assert projected_box(rows, ends, (0, 2)) is None
    assert projected_box(rows, np.array([[-1.0, -np.inf], [1.0, 1.5]]), (0, 1)) is None
    outline = projected_box(rows, ends, (0, 1))
    np.testing.assert_allclose([outline.min(axis=0), outline.max(axis=0)], [[-2.0, -2.0], [2.0, 6.0]])
    assert len(outline) == 5


@pytest.mark.parametrize(
    ("names", "pair"),
    [
        (["penalized", "monitor", "unshielded", "shielded:switch", "shielded"], ["unshielded", "shielded:switch"]),
        (["monitor", "shielded+penalty"], ["monitor", "shielded+penalty"]),
        (["shielded"], ["shielded"]),
        (["penalized"], ["penalized"]),
    ],
)
def test_time_series_show_the_shielded_arm_and_an_unshielded_one(names, pair):
    figure = episode_figure(random_plant(1, 2, 1), arms(*names, runs=1, trajectory=trajectory(np.zeros((3, 2)))))
    assert f"of the first run, {' and '.join(pair)}, with" in figure.caption


@pytest.mark.parametrize(("n", "m"), [(2, 1), (4, 1), (4, 2)])
def test_time_series_have_a_panel_for_states_inputs_and_events(n, m):
    plant = random_plant(1, n, m)
    path = trajectory(np.zeros((11, n)), m, intervened=(2, 3), arrivals=(0, 4, 5))
    figure = episode_figure(plant, arms("shielded", runs=1, trajectory=path))
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
        figure = episode_figure(plant, arms("unshielded", trajectory=path))
        assert any(line.get_marker() == "x" for line in figure.axes[0].get_lines()) is marked
        assert ("violation" in texts(figure)) is marked


def test_violations_of_limits_that_states_do_not_show_are_marked_too():
    """Of inputs and their changes, and between two samples: what the infos of the steps counted."""
    plant = random_plant(1, 2, 1)
    path = trajectory(np.zeros((11, 2)), violated=(2, 7))
    (crosses,) = [
        line for line in episode_figure(plant, arms("unshielded", trajectory=path)).axes[0].get_lines()
        if line.get_marker() == "x"
    ]  # fmt: skip
    np.testing.assert_allclose(crosses.get_xdata(), plant.dt * np.array([3, 8]))
    figure = phase_figure(plant, BALL, arms("unshielded", trajectory=path))
    marked = [line for line in figure.axes[0].get_lines() if line.get_marker() == "x"]
    assert {len(line.get_xdata()) for line in marked} == {2}


def test_an_episode_that_ended_early_stands_beside_a_longer_one():
    plant = random_plant(1, 4, 1)
    shown = {
        "unshielded": [run("unshielded", trajectory=trajectory(np.zeros((5, 4)), arrivals=(0, 1)))],
        "shielded": [run("shielded", trajectory=trajectory(np.zeros((11, 4)), arrivals=(0, 1, 7)))],
    }
    figure = episode_figure(plant, shown)
    assert figure.axes[-1].get_xlim() == (0.0, 1.0)
    assert [t[-3:] for t in texts(figure) if "packet" in t] == ["(2)", "(3)"]
    assert "ended at its first violation" in episode_figure(plant, shown).caption


def test_a_monitor_only_would_override():
    plant = random_plant(1, 2, 1)
    shown = arms("monitor", runs=1, trajectory=trajectory(np.zeros((11, 2)), intervened=(1,)))
    assert "would override, monitor (1)" in texts(episode_figure(plant, shown))
    assert "would have" in episode_figure(plant, shown).caption


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


@pytest.mark.parametrize(
    ("names", "runs", "says"),
    [
        (("lqr", "lqr+shielded"), 2, "interval of the mean return over episodes"),
        (
            ("lqr",),
            1,
            "A marker is one run; vertical bars are Student's 95 % interval of the mean return over episodes",
        ),
        (("lqr", "shielded"), 1, "an agent has no interval, that of a policy without training Student's 95 %"),
        (("lqr", "shielded"), 3, "mean return over runs (of policies without training, over episodes)"),
        (("unshielded", "shielded"), 3, "mean return over runs, horizontal"),
    ],
)
def test_scatter_says_what_its_vertical_bars_are_over(names, runs, says):
    assert says in scatter_figure(summary_of(arms(*names, runs=runs))["arms"]).caption


def test_arms_that_coincide_have_markers_of_different_sizes():
    shown = arms(*ALL_ARMS)
    for axis in scatter_figure(summary_of(shown)["arms"]).axes:
        means = [line.get_markersize() for line in axis.get_lines() if len(line.get_xdata()) == 1]
        assert means == sorted(set(means), reverse=True)
        assert len(means) == len(ALL_ARMS)


def test_every_figure_is_a_png_with_a_caption_of_its_own(plant):
    shown = arms(*ALL_ARMS[:5])
    figures = comparison_figures(plant, BALL, summary_of(shown), shown)
    assert set(figures) == {"training", "scatter", "phase", "episode"}
    assert all(png.startswith(b"\x89PNG") for _, png in figures.values())
    assert len({caption for caption, _ in figures.values()}) == 4


def test_a_single_state_has_no_phase_plane():
    single = LinearPlant(A=[[0.9]], B=[[1.0]], box=[1.0], u_max=1.0, dt=0.1, disturbance_bound=0.01, initial_bound=0.0)
    shown = arms("unshielded", "shielded", trajectory=trajectory(np.zeros((11, 1))))
    with without_pictures():
        figures = comparison_figures(single, SimpleNamespace(L=np.eye(1), polytope=None), summary_of(shown), shown)
    assert set(figures) == {"training", "scatter", "episode"}


def test_log_of_a_loop_has_the_ends_of_every_limit(tmp_path):
    plant = LinearPlant(
        A=[[0.9, 0.0], [0.1, 0.9]], B=[[0.1], [0.0]], dt=1.0, state_limits=([-0.5, -np.inf], [4.0, 2.0]),
        input_limits=(-1.0, 3.0), disturbance_bound=0.01, sensor_bound=0.01, initial_bound=0.01,
        operating_input=[0.5],
    )  # fmt: skip
    names = [*plant.state_names, *plant.input_names]
    log = StepLog(tmp_path, "controller", ["episode", "step", "x_hat_x1", "x_hat_x2", f"u_{names[2]}", "guaranteed"])
    for step in range(5):
        log.write([0, step, 0.5, 0.25, 0.1, int(step != 3)])
    log.close()
    figure = loop_log_figure(tmp_path, plant, 5)
    drawn = [[set(line.get_ydata()) for line in axis.lines if line.get_label() != "controller"] for axis in figure.axes]
    assert drawn == [[{-0.5}, {4.0}], [{2.0}], [{-1.5}, {2.5}]]
    assert figure.axes[2].get_ylabel() == "u1 - 0.5"
    for axis in figure.axes:
        np.testing.assert_array_equal(axis.collections[0].get_segments(), [[[3.0, 0.0], [3.0, 1.0]]])
