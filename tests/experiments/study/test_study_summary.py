import json

import numpy as np
import pytest

from experiments.analysis.episodes import episodes_table
from experiments.analysis.statistics import clopper_pearson
from experiments.study.channel_switches import SWITCHES
from experiments.study.figures import return_figure, study_figures
from experiments.study.study import quoted
from experiments.study.summary import (
    PRIMARY,
    Comparison,
    difference,
    margins_needed,
    members,
    outer_interval,
    study_summary,
)
from experiments.study.tables import (
    comparisons_table,
    evaluation_table,
    impairments_table,
    margins_table,
    network_table,
    prices_table,
    switches_table,
    tables_by_name,
)
from tests.experiments.results import run, summary_of

# Mean return, and the share of runs of which every second episode violates: as trained, and under attack.
ARMS = {
    "unshielded": (20.0, 0.0, 1.0),
    "trusting:20": (12.0, 0.0, 0.5),
    "lookahead": (11.0, 0.0, 0.0),
    "lqr+psf": (14.0, 1.0, 1.0),
    "lqr+psf:10": (13.0, 0.0, 1.0),
    "lqr+psf:20": (12.0, 0.0, 0.0),
    "lqr+psf:tube": (5.0, 0.0, 0.0),
    "lqr+lookahead": (13.5, 0.0, 0.0),
}
TRAINED = ("unshielded", "trusting:20", "lookahead")
RUNS = 4


def study(**changed):
    """A study of one environment: its summary, and the table of episodes."""
    results = {}
    for name, (mean, own, attacked) in (ARMS | changed).items():
        results[name] = []
        for index in range(RUNS):
            offset = mean + 0.1 * index

            def played(share, name=name, index=index, offset=offset):
                return run(name, index, (int(index < share * RUNS), 0), (offset, offset + 2.0)).episodes

            each = run(name, index, (int(index < own * RUNS), 0), (offset, offset + 2.0), train_steps=100)
            each.scenarios.update({"ideal channel": played(0.0), "attacked": played(attacked)})
            each.scenarios["attacked on an ideal channel"] = played(0.0)
            results[name].append(each if name in TRAINED else run(name, index, train_steps=0, train_violation_steps=0))
            if name not in TRAINED:
                results[name][-1].scenarios.update(each.scenarios)
                results[name][-1].episodes[:] = each.episodes
    comparison = json.loads(json.dumps(summary_of(results, seeds=RUNS)))
    comparison["references"] = {name: comparison["arms"].pop(name) for name in ARMS if name not in TRAINED}
    episodes = episodes_table(each for runs in results.values() for each in runs)
    return json.loads(json.dumps(study_summary({"Plant-v0": comparison}, {"Plant-v0": episodes}))), episodes


@pytest.fixture(scope="module")
def made():
    return study()


def env_of(made):
    return made[0]["environments"]["Plant-v0"]


def row(table, name):
    """The cells of a table's row that begins with a name."""
    return next(line for line in table.splitlines() if line.startswith(f"{name} "))


def test_differences_are_taken_run_by_run_and_resampled_by_runs(made):
    found = difference(made[1], Comparison("trusting:20", "lookahead", "attacked"))
    assert found["mean"] == 0.25
    assert found["by_run"] == [0.5, 0.5, 0.0, 0.0]
    assert found["interval"][0] == pytest.approx(0.0, abs=0.01)
    assert 0.4 < found["interval"][1] <= 0.7
    opposite = difference(made[1], Comparison("lookahead", "trusting:20", "attacked"))
    assert opposite["mean"] == -0.25
    assert difference(made[1], Comparison("psf:20", "lookahead", "attacked")) is None


def test_primary_comparison_comes_first_and_secondary_ones_share_a_level(made):
    first, *others = env_of(made)["comparisons"]
    assert (first["first"], first["second"], first["scenario"]) == PRIMARY
    assert (first["mean"], first["confidence"]) == (0.5, 0.95)
    assert [each["first"] for each in others] == ["trusting:20", "lqr+psf:20"]  # those whose arms there are
    assert all(each["confidence"] == pytest.approx(1.0 - 0.05 / 3.0) for each in others)
    title, primary, *secondary = comparisons_table(made[0]).splitlines()[3:]
    assert title == "Plant-v0"
    assert primary.split()[:5] == ["unshielded", "-", "lookahead", "(primary)", "+50.0"]
    assert len(secondary) == 2
    assert not any("primary" in line for line in secondary)


def test_arms_have_rates_of_every_run_and_intervals_over_runs(made):
    arm = env_of(made)["arms"]["trusting:20"]["scenarios"]["attacked"]
    assert arm["rate_by_run"] == [0.5, 0.5, 0.0, 0.0]
    assert (arm["episodes"], arm["violating"], arm["rate"]) == (8, 2, 0.25)
    assert arm["rate_ci95"][0] <= clopper_pearson(2, 8)[0] < 0.25 < clopper_pearson(2, 8)[1] <= arm["rate_ci95"][1]
    nothing = env_of(made)["arms"]["lookahead"]["scenarios"]["attacked"]
    assert nothing["rate_ci95"][0] == 0.0 < nothing["rate_ci95"][1]  # resampling zeros would say that it is certain


def test_interval_of_a_rate_contains_the_exact_one():
    assert outer_interval([0.0, 0.012], [0.0001, 0.022]) == [0.0, 0.022]
    assert outer_interval([0.5, 0.7], [0.56, 0.69]) == [0.5, 0.7]
    assert outer_interval(None, [0.0, 0.1]) is None


def test_price_is_that_of_the_best_arm_that_violates_anywhere(made):
    agents, regulators = env_of(made)["prices"]
    assert (agents["second"], agents["mean"]) == ("unshielded", pytest.approx(-9.0))
    assert regulators["second"] == "lqr+psf"
    assert regulators["mean"] == pytest.approx(-0.5)
    assert "-9.0" in prices_table(made[0])


def test_rates_are_percentages(made):
    assert "50.0" in row(evaluation_table(env_of(made)), "unshielded")


def test_margins_are_the_smallest_without_a_violation(made):
    env = env_of(made)
    assert list(members(env, "lqr+psf")) == ["lqr+psf", "lqr+psf:10", "lqr+psf:20"]  # a tube is no margin
    assert margins_needed(env, "lqr+psf", "as trained") == "lqr+psf:10"
    assert margins_needed(env, "lqr+psf", "attacked") == "lqr+psf:20"
    assert row(margins_table(made[0]), "Plant-v0 lqr+psf").split()[2:] == ["10", "%", "20", "%", "-1.5", "-2.0"]
    never = study(**{"lqr+psf:20": (12.0, 0.0, 1.0)})
    assert row(margins_table(never[0]), "Plant-v0 lqr+psf").split()[2:] == ["10", "%", ">", "20", "%", "-0.5", "-1.0"]


def test_effect_of_the_network_is_shown_of_the_filter_that_trusts_its_estimate_and_of_the_proof(made):
    trusting, sound = [line.split() for line in network_table(made[0]).splitlines()[3:]]
    assert trusting[:5] == ["Plant-v0", "trusting:20", "0.0", "0.0", "25.0"]
    assert sound[:5] == ["Plant-v0", "lookahead", "0.0", "0.0", "0.0"]


def test_switches_are_a_row_per_combination():
    rows = [
        {"on": on, "arm": arm, "episodes": 4, "violating": len(on) * (arm == "lqr")}
        for on in ([], ["loss"], ["loss", "delay"], ["loss", "delay", "rate", "rounding"])
        for arm in ("lqr", "lookahead")
    ]
    table = switches_table(rows)
    assert [line.split()[-2:] for line in table.splitlines()[3:]] == [
        ["0", "0"],
        ["25", "0"],
        ["50", "0"],
        ["100", "0"],
    ]
    assert table.splitlines()[-1].startswith("all four")


def test_impairments_alone_are_a_row_per_arm():
    rows = [
        {"on": on, "arm": arm, "episodes": 4, "violating": len(on) * (arm == "lqr")}
        for on in ([], *([each] for each in SWITCHES), ["loss", "delay"], [*SWITCHES])
        for arm in ("lqr", "lookahead")
    ]
    table = impairments_table({"Plant-v0": rows, "Other-v0": rows}).splitlines()
    assert table[0].split()[3:] == ["ideal", "loss", "delay", "rate", "rounding", "all", "four"]
    assert table[2].split() == ["Plant-v0", "lqr", "0", "25", "25", "25", "25", "100"]
    assert [line.split()[:2] for line in table[3:]] == [
        ["Plant-v0", "lookahead"],
        ["Other-v0", "lqr"],
        ["Other-v0", "lookahead"],
    ]


def test_pages_show_the_same_after_their_numbers_were_stored(made):
    assert tables_by_name(json.loads(json.dumps(made[0]))) == tables_by_name(made[0])


def test_quoted_tables_replace_what_stands_between_the_marks():
    page = "before\n<!-- ncs study: agents -->\n```\nold\n```\n<!-- end -->\nafter <!-- end -->"
    once = quoted(page, {"agents": "new"})
    assert once == "before\n<!-- ncs study: agents -->\n```\nnew\n```\n<!-- end -->\nafter <!-- end -->"
    assert quoted(once, {"agents": "new"}) == once


def test_rows_of_the_figure_have_names_and_small_margins_are_left_out():
    summary = study(**{"trusting:10": (10.0, 0.0, 0.5), "penalized:10": (11.0, 0.0, 0.5)})[0]
    figure = return_figure(summary)
    named = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert {"penalized:10", "trusting:20", "lqr+psf", "lqr+psf:20", "lookahead"} <= set(named)  # a price is no margin
    assert not {"trusting:10", "lqr+psf:10"} & set(named)
    assert len(set(named)) == len(named)
    assert figure.legends == []
    assert {line.get_marker() for axis in figure.axes for line in axis.lines} <= {"o", "None"}


@pytest.mark.parametrize("environments", [1, 3])
def test_names_of_the_rows_do_not_cover_one_another(made, environments):
    summary = made[0] | {"environments": {f"Plant-v{i}": env_of(made) for i in range(environments)}}
    figure = return_figure(summary)
    figure.canvas.draw()
    texts = [text for axis in figure.axes for text in (*axis.get_yticklabels(), axis.title, axis.xaxis.label)]
    boxes = [text.get_window_extent() for text in texts if text.get_visible() and text.get_text()]
    # Tick labels of shared panels are not drawn and lie where those of the first one would.
    assert not any(one.overlaps(other) for i, one in enumerate(boxes) for other in boxes[:i])


def test_figures_show_every_arm_and_every_run(made):
    figures = study_figures(made[0])
    assert figures.keys() == {"return", "runs", "training"}
    assert all(png.startswith(b"\x89PNG") for _, png in figures.values())
    assert np.all([caption for caption, _ in figures.values()])
