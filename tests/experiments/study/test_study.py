import json
from unittest import mock

import pyarrow.parquet as pq
import pytest

from experiments.settings import StudySettings
from experiments.study.study import study
from tests.workers import no_worker_processes

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
ONE_CHANNEL = {"_LOSSES": (0.9,), "_DELAYS": (), "_QUANTIZATION": ()}
MARKED = "# A page\n\n<!-- ncs study: lead -->\n<!-- end -->\n"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    (out / "quoting.md").write_text(MARKED)
    settings = StudySettings(
        envs=(CRUISE,),
        out=out / "out",
        page=out / "docs" / "results.md",
        quote=(out / "quoting.md",),
        seeds=2,
        budget=0.01,
        episodes=2,
        channel_episodes=2,
        jobs=1,
        arms=("unshielded", "shielded"),
        baselines=("random+shielded", "lqr+trusting", "lqr+shielded"),
        scenarios=("worst-case-disturbance",),
    )
    with no_worker_processes(), mock.patch.multiple("experiments.study.channel_sweep", **ONE_CHANNEL):
        study(settings)
        yield settings


def test_study_leaves_its_files(finished):
    names = {path.name for path in finished.out.iterdir()}
    assert names >= {"report.html", "results.md", "summary.json", "episodes.parquet", "settings.json", "figures"}
    summary = json.loads((finished.out / "summary.json").read_text())
    env = summary["environments"]["TruckTrailerCruise-v0"]
    assert env["steps"] == 1500  # one per cent of the steps tuned for the cruise
    assert len(env["pairs"]["return"]) == 10
    assert env["prices"][0]["sound"] == "lqr+shielded"
    assert summary["scores"]["lqr+shielded"]["ci95"] is not None
    assert "Report of this comparison" in (finished.out / "report.html").read_text()


def test_table_has_every_episode_of_every_environment_arm_condition_and_run(finished):
    rows = pq.read_table(finished.out / "episodes.parquet").to_pylist()
    assert len({(row["environment"], row["arm"], row["condition"], row["run"]) for row in rows}) == 5 * 2 * 2
    assert len(rows) == 5 * 2 * 2 * 2
    assert {row["condition"] for row in rows} == {"as trained", "worst-case disturbance"}
    shielded = [row for row in rows if row["arm"].endswith("shielded")]
    assert not any(row["violating"] or row["outside_set"] for row in shielded)


def test_page_quotes_and_figures_are_written_where_they_were_asked_for(finished):
    page = finished.page.read_text()
    of_channels = [f"results-trusting-{kind}TruckTrailerCruise-v0.png" for kind in ("", "agents-")]
    for link in ("results-return.png", "results-training.png", *of_channels):
        assert f"images/{link}" in page
        assert (finished.page.parent / "images" / link).is_file()
    assert "lqr+shielded" in finished.quote[0].read_text()
    assert json.loads(finished.page.with_suffix(".json").read_text())["environments"]


def test_finished_runs_are_kept_and_give_the_same_summary(finished, capsys):
    before = (finished.out / "summary.json").read_bytes()
    study(finished)
    messages = capsys.readouterr().err
    assert "10 of 10 runs were finished before" in messages
    assert "6 of 6 runs were finished before" in messages  # of the sweep: the regulator's and those of two agents
    assert (finished.out / "summary.json").read_bytes() == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"budget": 0.0}, "--budget"),
        ({"budget": 1.5}, "--budget"),
        ({"seeds": 0}, "--seeds"),
        ({"envs": ()}, "--envs"),
        ({"envs": (CRUISE, CRUISE)}, "--envs"),
        ({"channel_episodes": -1}, "--channel-episodes"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        StudySettings(**change)


def test_a_page_without_marks_is_refused_before_anything_runs(tmp_path):
    (tmp_path / "page.md").write_text("no mark")
    with pytest.raises(ValueError, match="no mark"):
        study(StudySettings(out=tmp_path / "out", quote=(tmp_path / "page.md",)))
    assert not (tmp_path / "out").exists()
