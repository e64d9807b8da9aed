import json

import numpy as np
import pytest

from experiments.analysis.statistics import paired_difference
from experiments.study.figures import study_figures
from experiments.study.pages import quoted
from experiments.study.summary import page_summary, sound_counterpart, study_summary
from experiments.study.tables import (
    evaluation_table,
    overview_table,
    pairs_table,
    price_table,
    simpler_table,
    tables_by_name,
    training_table,
)
from tests.experiments.results import run, summary_of

RETURNS = {
    "unshielded": 20.0,
    "trusting": 12.0,
    "shielded": 10.0,
    "lookahead": 11.0,
    "random+shielded": 0.0,
    "lqr": 21.0,
    "lqr+trusting": 13.5,
    "lqr+shielded": 12.5,
    "zero input": -40.0,
}
VIOLATING = {"unshielded", "trusting", "lqr", "lqr+trusting"}
TRAINED = ("unshielded", "trusting", "shielded", "lookahead")


def comparison(seeds=5, spread=0.1, **changed):
    """A comparison in which the arms of VIOLATING violate in every second episode."""
    rng = np.random.default_rng(0)
    results = {}
    for name, mean in (RETURNS | changed).items():
        offsets = mean + spread * rng.standard_normal(seeds)
        counts = (int(name in VIOLATING), 0)
        results[name] = [run(name, i, counts, (offset, offset)) for i, offset in enumerate(offsets)]
        for each in results[name]:
            each.scenarios["worst-case disturbance"] = each.episodes
    summary = json.loads(json.dumps(summary_of(results, seeds=seeds)))
    summary["references"] = {name: summary["arms"].pop(name) for name in RETURNS if name not in TRAINED}
    return summary


def study(**environments):
    return study_summary(environments or {"Plant-v0": comparison()})


def row(table, name):
    """The cells of a table's row that begins with a name."""
    return next(line for line in table.splitlines() if line.startswith(f"{name} "))


def test_overview_has_rates_as_trained_and_at_worst_of_every_environment():
    summary = page_summary(study(One=comparison(), Two=comparison(unshielded=7.0)))
    arm = summary["environments"]["One"]["arms"]["lookahead"]
    arm["conditions"]["worse channel"] = arm["conditions"]["worst-case disturbance"] | {"eval_violation_rate": 0.25}
    violating, returns = overview_table(summary).split("\n\n")
    names = ["unshielded", "shielded", "lookahead", "lqr+shielded"]
    assert violating.splitlines()[0].split()[-4:] == returns.splitlines()[0].split()[-4:] == names
    assert row(violating, "One").split()[1:] == ["50.0/50.0", "0.0/0.0", "0.0/25.0", "0.0/0.0"]
    assert row(violating, "Two").split()[1:] == ["50.0/50.0", "0.0/0.0", "0.0/0.0", "0.0/0.0"]
    for title, env in summary["environments"].items():
        assert row(returns, title).split()[1:] == [f"{env['arms'][name]['eval_return_mean']:.1f}" for name in names]


def test_every_pair_of_arms_is_compared_by_seed():
    env = study()["environments"]["Plant-v0"]
    count = len(RETURNS)
    assert [len(pairs) for pairs in env["pairs"].values()] == [count * (count - 1) // 2] * 2
    pair = next(p for p in env["pairs"]["return"] if {p["first"], p["second"]} == {"shielded", "lqr"})
    by_run = (env["arms"][pair[side]]["eval_return_by_run"] for side in ("first", "second"))
    assert pair["mean"] == paired_difference(*by_run)["mean"]
    violating = next(p for p in env["pairs"]["violating episodes"] if {p["first"], p["second"]} == {"shielded", "lqr"})
    assert abs(violating["mean"]) == 0.5


@pytest.mark.parametrize(
    ("name", "sound"),
    [
        ("trusting", "shielded"),
        ("trusting:lookahead", "lookahead"),
        ("lqr+trusting", "lqr+shielded"),
        ("trusting at test", "shield at test"),
        ("psf", None),
    ],
)
def test_a_trusting_arm_differs_from_its_counterpart_in_the_error_set_alone(name, sound):
    assert sound_counterpart(name) == sound


def test_price_of_soundness_is_with_minus_without_the_error_set():
    env = study()["environments"]["Plant-v0"]
    prices = {price["trusting"]: price for price in env["prices"]}
    assert prices.keys() == {"trusting", "lqr+trusting"}
    assert prices["trusting"]["return"]["mean"] == pytest.approx(-2.0, abs=0.3)
    table = price_table({"environments": {"Plant-v0": env}})
    assert "0.0/50.0 %" in row(table, "shielded")


def test_scores_are_between_random_and_regulator_behind_the_shield():
    other = comparison(**{name: 3.0 * value - 7.0 for name, value in RETURNS.items()})
    scores = study(one=comparison(), other=other)["scores"]
    assert scores["random+shielded"]["iqm"] == pytest.approx(0.0, abs=0.02)
    assert scores["lqr+shielded"]["iqm"] == pytest.approx(1.0, abs=0.02)
    assert scores["shielded"]["iqm"] == pytest.approx(0.8, abs=0.02)
    low, high = scores["shielded"]["ci95"]
    assert low < scores["shielded"]["iqm"] < high


def test_there_are_no_scores_without_what_they_are_measured_by():
    incomplete = comparison()
    del incomplete["references"]["random+shielded"]
    assert study(one=comparison(), other=incomplete)["scores"] == {}


def test_verdicts_follow_violations_and_adjusted_p_values():
    table = simpler_table(page_summary(study()))
    assert row(table, "lqr").endswith("violates")
    assert row(table, "lqr+shielded").endswith("wins")
    assert row(table, "zero input").endswith("loses")
    unclear = simpler_table(page_summary(study(plant=comparison(spread=60.0))))
    assert row(unclear, "lqr+shielded").endswith("not shown")


def test_differences_keep_their_sign_whichever_arm_comes_first():
    table = pairs_table(page_summary(study())["environments"]["Plant-v0"])
    first, second = table.split("\n\n")
    differences = [row(*at).split()[1] for at in ((first, "unshielded"), (second, "shielded"), (first, "lookahead"))]
    assert [float(each) for each in differences] == pytest.approx([10.0, -1.0, 1.0], abs=0.25)
    assert differences[1][1:] == differences[2][1:]


def test_tables_fit_a_terminal():
    shown = page_summary(study())
    env = shown["environments"]["Plant-v0"]
    tables = [evaluation_table(env), training_table(env), pairs_table(env), price_table(shown), simpler_table(shown)]
    assert max(len(line) for table in tables for line in table.splitlines()) <= 100


def test_pages_show_the_same_after_their_numbers_were_stored():
    summary = study() | {"channels": {}}
    stored = json.loads(json.dumps(page_summary(summary)))
    assert tables_by_name(stored) == tables_by_name(page_summary(summary))
    assert stored["environments"]["Plant-v0"]["arms"]["shielded"].keys().isdisjoint({"eval_return_by_run"})


def test_quoted_tables_replace_what_stands_between_the_marks():
    page = "before\n<!-- ncs study: lead -->\n```\nold\n```\n<!-- end -->\nafter <!-- end -->"
    once = quoted(page, {"lead": "new"})
    assert once == "before\n<!-- ncs study: lead -->\n```\nnew\n```\n<!-- end -->\nafter <!-- end -->"
    assert quoted(once, {"lead": "new"}) == once


@pytest.mark.parametrize(("page", "message"), [("no mark", "no mark"), ("<!-- ncs study: x -->\n<!-- end -->", "'x'")])
def test_pages_without_a_known_mark_are_refused(page, message):
    with pytest.raises(ValueError, match=message):
        quoted(page, {"lead": "new"})


def test_figures_show_every_arm():
    figures = study_figures(page_summary(study()) | {"channels": {}})
    assert figures.keys() == {"return", "training"}
    assert all(png.startswith(b"\x89PNG") for _, png in figures.values())
