"""The study: declared comparisons, intervals over runs, tables of exact numbers, and impairments on and off."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest

from agents.agent_file import AGENT_FILES
from benchmarks import study as script
from benchmarks.study import (
    ENVS,
    PRIMARY,
    SWITCHES,
    all_tables,
    comparisons_table,
    difference,
    environment,
    margins_table,
    network_table,
    prices_table,
    quotable,
    switched,
)
from benchmarks.study_figures import study_figures
from experiments.analysis.episodes import episodes_table
from experiments.analysis.statistics import clopper_pearson
from experiments.commands.compare import CompareSettings
from experiments.runs.loops import changed_channel
from ncs_gym.envs.env import ncs_env
from tests.experiments.results import run, summary_of
from tests.workers import no_worker_processes

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
    with mock.patch("experiments.analysis.statistics.RESAMPLES", 500):  # nobody reads these intervals
        comparison = json.loads(json.dumps(summary_of(results, seeds=RUNS)))
    comparison["references"] = {name: comparison["arms"].pop(name) for name in ARMS if name not in TRAINED}
    episodes = episodes_table(each for runs in results.values() for each in runs)
    summary = {"environments": {"Plant-v0": environment(comparison, episodes)}, "channels": {"Plant-v0": switches()}}
    return json.loads(json.dumps(summary)), episodes


def switches():
    """Rows of impairments: the regulator violates in as many of four episodes as are on."""
    points = [[], *([each] for each in SWITCHES), [*SWITCHES]]
    return [
        {"on": on, "arm": arm, "episodes": 4, "violating": len(on) * (arm == "lqr")}
        for on in points
        for arm in ("lqr", "lookahead")
    ]


@pytest.fixture(scope="module")
def made():
    return study()


def env_of(made):
    return made[0]["environments"]["Plant-v0"]


def row(table, name):
    """The cells of a table's row that begins with a name."""
    return next(line for line in table.splitlines() if line.startswith(f"{name} "))


def test_differences_are_taken_run_by_run_and_resampled_by_runs(made):
    found = difference(made[1], ("trusting:20", "lookahead", "attacked"))
    assert found["mean"] == 0.25
    assert found["interval"][0] == pytest.approx(0.0, abs=0.01)
    assert 0.4 < found["interval"][1] <= 0.7
    assert difference(made[1], ("lookahead", "trusting:20", "attacked"))["mean"] == -0.25
    assert difference(made[1], ("psf:20", "lookahead", "attacked")) is None


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


def test_price_is_that_of_the_best_arm_that_violates_anywhere(made):
    agents, regulators = env_of(made)["prices"]
    assert (agents["second"], agents["mean"]) == ("unshielded", pytest.approx(-9.0))
    assert regulators["second"] == "lqr+psf"
    assert regulators["mean"] == pytest.approx(-0.5)
    assert "-9.0" in prices_table(made[0])


def test_margins_are_the_smallest_without_a_violation(made):
    def cells(summary):
        return row(margins_table(summary), "Plant-v0 lqr+psf").split()[2:]

    assert cells(made[0]) == ["10", "%", "20", "%", "-1.5", "-2.0"]  # a tube is no margin
    never = study(**{"lqr+psf:20": (12.0, 0.0, 1.0)})
    assert cells(never[0]) == ["10", "%", ">", "20", "%", "-0.5", "-1.0"]


def test_tables_have_every_arm_and_no_negative_zero(made):
    tiny = study(**{"lookahead": (-2.0, 0.0, 0.0), "trusting:20": (-2.0 + 1e-9, 0.0, 0.5)})[0]
    for summary in (made[0], tiny):
        text = all_tables(summary)
        assert all(f"\n{name} " in text for name in ARMS)
        assert not re.search(r"(?<![\d.])-0(\.0+)?(?![\d.])", text)
        assert max(map(len, text.splitlines())) <= 80
    assert quotable(json.loads(json.dumps(made[0]))) == quotable(made[0])


def test_figures_show_every_arm_and_every_run(made):
    figures = study_figures(made[0])
    assert figures.keys() == {"violations", "return", "training"}
    assert all(png.startswith(b"\x89PNG") for png in figures.values())


@pytest.mark.parametrize("env_id", [*ENVS, "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/CartPole-v0"])
def test_every_impairment_keeps_the_contract_and_has_what_is_on(env_id):
    env = ncs_env(gym.make(env_id))
    for on in ((), *((each,) for each in SWITCHES), SWITCHES):
        channel = changed_channel(env.channel, switched(env.channel, env.contract, on)) or env.channel
        assert env.contract is None or env.contract.is_kept_by(channel)
        assert (
            channel.loss > 0.0,
            channel.delay > 0,
            channel.send_period > 1,
            channel.quantization_step > 0.0,
        ) == tuple(name in on for name in SWITCHES)


@pytest.mark.slow
def test_a_small_study_shows_that_losses_decide_for_the_regulator_and_nothing_breaks_lookahead(tmp_path):
    def made():
        script.compare(
            env=ENVS[:1],
            arms=("unshielded", "lookahead"),
            baselines=("lqr", "lqr+trusting", "lqr+shielded", "lqr+lookahead"),
            seeds=2,
            steps=1500,
            episodes=2,
            channel_episodes=12,
            jobs=1,
            out=tmp_path / "out",
            numbers=tmp_path / "results.json",
        )
        return json.loads((tmp_path / "results.json").read_text())

    with no_worker_processes():
        summary = made()
        assert made() == summary  # finished runs are kept
    env = summary["environments"]["CSTR-v0"]
    assert env["steps"] == 1500
    assert [each["first"] for each in env["comparisons"]] == ["unshielded"]
    assert len(env["arms"]["unshielded"]["scenarios"]["attacked"]["rate_by_run"]) == 2
    assert len(env["arms"]["unshielded"]["scenarios"]) == 5
    sound = [env["arms"][name]["scenarios"].values() for name in ("lookahead", "lqr+lookahead", "lqr+shielded")]
    assert not any(each["violating"] for scenarios in sound for each in scenarios)
    rows = summary["channels"]["CSTR-v0"]
    violating = {(tuple(each["on"]), each["arm"]): each["violating"] for each in rows}
    assert violating[(), "lqr"] == 0
    assert violating[("loss",), "lqr"] >= 3
    assert all(count == 0 for (_, arm), count in violating.items() if arm.endswith("lookahead"))
    assert all(each["episodes"] == 12 for each in rows)
    assert np.isfinite([arm["scenarios"]["attacked"]["return"] for arm in env["arms"].values()]).all()
    assert "CSTR-v0 lookahead" in network_table(summary) + all_tables(summary)


def test_switched_impairments_are_met_by_the_agents_of_the_comparison(monkeypatch, tmp_path):
    """The results of runs come without the agents' files, which are in the comparison's folder."""
    arm, met = script.SWITCHED_AGENTS[0], []
    results = [run(arm, index) for index in range(2)]
    for each in results:
        (folder := tmp_path / "models" / f"{arm}-{each.index}").mkdir(parents=True)
        for name in AGENT_FILES:
            (folder / name).write_bytes(f"{name} {each.index}".encode())

    def played(runs, *rest):
        met.extend(runs)
        return [replace(result, scenarios={script.ATTACKED: result.episodes}) for result in results]

    monkeypatch.setattr(script, "results_of", played)
    settings = CompareSettings(env=ENVS[0], arms=(arm,), scenarios=(script.ATTACKED,), out=tmp_path / "channels")
    script.channel_switches(settings, SimpleNamespace(results=results), tmp_path / "models")
    agents = [each for each in met if each.arm == arm]
    assert len(agents) == 2 * (len(SWITCHES) + 2)
    assert not any(each.trains for each in met)
    for each in agents:
        assert each.agent_files == {name: f"{name} {each.index}".encode() for name in AGENT_FILES}
