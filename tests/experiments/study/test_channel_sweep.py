import json
from dataclasses import replace
from unittest import mock

import gymnasium as gym
import pytest

from experiments.backends.execution import results_of
from experiments.errors import ResultsError
from experiments.runs import certificate_of, loop_config, run_of_arm
from experiments.settings import CompareSettings, changed_channel
from experiments.study.channel_sweep import SWEPT_FILTERS, SWEPT_SCENARIOS, channel_sweep, trained_agents
from experiments.study.channel_sweep import _points as points_of
from experiments.study.figures import sweep_figure
from experiments.study.tables import channels_table
from ncs_gym.envs.env import ncs_env
from tests.workers import no_worker_processes

CRUISE, REACTOR = "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/BatchReactor-v0"


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    settings = CompareSettings(env=CRUISE, episodes=3, jobs=1, out=tmp_path_factory.mktemp("sweep"))
    few = {"_LOSSES": (0.9,), "_DELAYS": (4,), "_QUANTIZATION": (4.0,)}  # where it is hardest
    with no_worker_processes(), mock.patch.multiple("experiments.study.channel_sweep", **few):
        return channel_sweep(settings, {}), channel_sweep(settings, {})


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A comparison with two short trainings behind every filter, its results, and its agents."""
    out = tmp_path_factory.mktemp("trained")
    settings = CompareSettings(
        env=CRUISE,
        arms=("unshielded", *SWEPT_FILTERS),
        seeds=2,
        steps=256,
        hyperparams=dict(n_envs=8, n_steps=32, batch_size=64),
        episodes=2,
        jobs=1,
        out=out,
    )
    loop = loop_config(CRUISE)
    certificate = certificate_of(loop)
    runs = [
        run_of_arm(settings.completed, loop, certificate, name, index) for name in SWEPT_FILTERS for index in range(2)
    ]
    with no_worker_processes():
        results = results_of(runs, out, settings)
    return settings, results, trained_agents(settings)


@pytest.fixture(scope="module")
def sweep_of_agents(trained):
    """What the agents do on the environment's own channel, and the messages of a sweep that had none at first."""
    settings, _, agents = trained
    settings = replace(settings, episodes=4, out=settings.out / "channels")
    own = {"_LOSSES": (ncs_env(gym.make(CRUISE)).channel.loss,), "_DELAYS": (), "_QUANTIZATION": ()}
    with no_worker_processes(), mock.patch.multiple("experiments.study.channel_sweep", **own):
        return channel_sweep(settings, {}), channel_sweep(settings, agents)


def test_with_the_error_set_nothing_leaves_and_without_it_the_worst_disturbance_drives_the_state_out(rows):
    for each in rows[0]:
        if each["arm"] == "lqr+shielded":
            assert each["outside_set"] == each["violating"] == 0
        if each["arm"] == "lqr+lookahead":
            assert each["violating"] == 0
    worst = [r for r in rows[0] if r["condition"] == "worst-case disturbance" and r["arm"] == "lqr+trusting"]
    assert all(each["outside_set"] == each["episodes"] == 3 for each in worst)


def test_a_finished_sweep_is_read_again(rows):
    assert rows[0] == rows[1]
    sides = {each["side"] for each in rows[0]}
    assert sides == {"loss", "delay", "quantization_step"}
    assert {(r["arm"], r["condition"]) for r in rows[0]} == {
        (f"lqr+{name}", condition) for name in SWEPT_FILTERS for condition in SWEPT_SCENARIOS
    }


def test_agents_do_on_the_own_channel_what_they_did_in_the_comparison(trained, sweep_of_agents):
    of_agents = {r["arm"]: r for r in sweep_of_agents[1] if r["condition"] == SWEPT_SCENARIOS[0]}
    for name in SWEPT_FILTERS:
        episodes = [episode for result in trained[1] if result.arm == name for episode in result.episodes]
        row = of_agents[name]
        assert (row["episodes"], row["policies"]) == (4, 2) == (len(episodes), len(trained[2][name]))
        assert row["outside_set"] == sum(episode.largest_level > 1.0 for episode in episodes)
        assert row["violating"] == sum(episode.violation_steps > 0 for episode in episodes)
        assert row["intervention_rate"] == sum(e.interventions for e in episodes) / sum(e.steps for e in episodes)


def test_a_sweep_without_agents_is_completed(sweep_of_agents):
    before, after = sweep_of_agents
    assert [row for row in after if row["arm"].startswith("lqr+")] == before
    assert {row["arm"] for row in after} - {row["arm"] for row in before} == set(SWEPT_FILTERS)


def test_with_the_error_set_no_agent_leaves(sweep_of_agents):
    assert all(row["outside_set"] == 0 for row in sweep_of_agents[1] if row["arm"] == "shielded")
    assert all(row["violating"] == 0 for row in sweep_of_agents[1] if row["arm"] in ("shielded", "lookahead"))


def test_agents_are_those_that_the_comparison_left(trained):
    settings, _, agents = trained
    assert tuple(agents) == SWEPT_FILTERS  # and not the unshielded one, which no filter was there for
    for name, each in agents.items():
        for index, files in enumerate(each):
            folder = settings.out / "models" / f"{name}-{index}".replace(":", "-")
            assert files == {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ResultsError, match="shielded-2"):
        trained_agents(replace(settings, arms=("shielded",), seeds=3))


def test_a_run_with_an_agent_trains_nothing_and_is_another_with_another_agent(trained):
    settings, _, agents = trained
    loop = loop_config(CRUISE)
    run = run_of_arm(settings, loop, certificate_of(loop), "shielded", 0)
    first, second = (replace(run, agent_files=files) for files in agents["shielded"])
    assert len({run.key, first.key, second.key}) == 3
    assert first.total_steps == run.episodes * 200 < run.total_steps
    result = first.execute(lambda steps: None)
    assert (result.train_steps, result.files, len(result.episodes)) == (0, {}, 2)
    assert result.episodes != second.execute(lambda steps: None).episodes


def test_figure_has_a_panel_for_every_side_and_measure(rows):
    figure = sweep_figure("Cruise", rows[0])
    assert len(figure.axes) == 6
    assert "3 episodes," in figure.caption
    for axis in (axis for axis in figure.axes if axis.get_xlabel() == "delay [steps]"):
        axis.set_xlim(0.0, 1.0)  # a range where round numbers would not be whole ones
        assert all(tick == round(tick) for tick in axis.get_xticks())


def test_figure_of_agents_says_how_many_there_are(sweep_of_agents):
    figure = sweep_figure("Cruise", [row for row in sweep_of_agents[1] if not row["arm"].startswith("lqr+")])
    assert "4 episodes of 2 agents" in figure.caption
    assert "regulator" not in figure.caption
    assert [len(axis.lines) for axis in figure.axes] == [2 * 2 * 2] * 2  # filters, disturbances, curve and interval


def test_table_has_both_ends_of_every_side_and_every_policy(rows, sweep_of_agents):
    left_set, left_box = channels_table(rows[0]).split("\n\n")
    assert left_set.split("\n")[0].split("  ")[-1].strip() == "step 0.2"
    assert "lqr+trusting " in left_set
    assert "lqr+trusting:lookahead " in left_box
    assert left_set.splitlines()[2].split()[1].endswith("/100")
    agents = channels_table(sweep_of_agents[1])
    assert [line.split()[0] for line in agents.splitlines() if line.startswith(SWEPT_FILTERS)] == list(SWEPT_FILTERS)


def test_rows_stored_by_a_sweep_without_agents_can_be_drawn(rows):
    old = [{name: value for name, value in row.items() if name != "policies"} for row in rows[0]]
    assert sweep_figure("Cruise", old).caption == sweep_figure("Cruise", json.loads(json.dumps(rows[0]))).caption


def test_channels_that_break_the_contract_are_left_out():
    env = ncs_env(gym.make(REACTOR))
    kept = points_of(REACTOR)
    assert kept
    assert all(env.contract.is_kept_by(changed_channel(env.channel, point.change) or env.channel) for point in kept)
    too_late = replace(kept[0], side="delay", value=float(env.contract.max_age + 1))
    assert too_late.name not in {point.name for point in kept}
    assert not env.contract.is_kept_by(changed_channel(env.channel, too_late.change))
