import json
from unittest import mock

import pyarrow.parquet as pq
import pytest

from experiments.settings import StudySettings
from experiments.study.study import study
from tests.command import without_pictures
from tests.workers import no_worker_processes

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
FEW = {"SWITCHES": ("loss",), "SWITCHED_REGULATORS": ("lqr+lookahead",)}
MARKED = "# A page\n\n<!-- ncs study: margins -->\n<!-- end -->\n"


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
        channel_episodes=1,
        jobs=1,
        arms=("unshielded", "lookahead"),
        baselines=("lqr", "lqr+trusting", "lqr+shielded"),
        scenarios=("ideal-channel", "attacked"),
    )
    with no_worker_processes(), without_pictures(), mock.patch.multiple("experiments.study.channel_switches", **FEW):
        study(settings)
        yield settings


@pytest.mark.slow
def test_study_leaves_its_files(finished):
    names = {path.name for path in finished.out.iterdir()}
    assert names >= {"report.html", "results.md", "results.txt", "figures"}
    assert names >= {"summary.json", "episodes.parquet", "settings.json"}
    summary = json.loads((finished.out / "summary.json").read_text())
    env = summary["environments"]["TruckTrailerCruise-v0"]
    assert env["steps"] == 1500  # one per cent of the steps tuned for the cruise
    assert [each["first"] for each in env["comparisons"]] == ["unshielded"]
    assert len(env["arms"]["unshielded"]["scenarios"]["attacked"]["rate_by_run"]) == 2
    assert {tuple(row["on"]) for row in summary["channels"]["TruckTrailerCruise-v0"]} == {(), ("loss",)}
    assert "Report of this comparison" in (finished.out / "report.html").read_text()


@pytest.mark.slow
def test_table_has_every_episode_of_every_environment_arm_condition_and_run(finished):
    rows = pq.read_table(finished.out / "episodes.parquet").to_pylist()
    assert len({(row["environment"], row["arm"], row["condition"], row["run"]) for row in rows}) == 5 * 3 * 2
    assert len(rows) == 5 * 3 * 2 * 2
    assert {row["condition"] for row in rows} == {"as trained", "ideal channel", "attacked"}
    shielded = [row for row in rows if row["arm"].endswith(("+shielded", "lookahead"))]
    assert not any(row["violating"] for row in shielded)


@pytest.mark.slow
def test_page_quotes_and_figures_are_written_where_they_were_asked_for(finished):
    page = finished.page.read_text()
    for link in ("results-return.png", "results-training.png", "results-runs.png"):
        assert f"images/{link}" in page
        assert (finished.page.parent / "images" / link).is_file()
    assert "TruckTrailerCruise-v0 lqr+trusting" in finished.quote[0].read_text()
    assert json.loads(finished.page.with_suffix(".json").read_text())["environments"]


@pytest.mark.slow
def test_all_tables_stand_beside_the_page_that_links_to_them(finished):
    assert "(results.txt)" in finished.page.read_text()
    tables = finished.page.with_suffix(".txt").read_text()
    for arm in ("lqr+trusting", "lqr+shielded", "unshielded"):
        assert f"\n{arm} " in tables
    assert tables == (finished.out / "results.txt").read_text()


@pytest.mark.slow
def test_finished_runs_are_kept_and_give_the_same_summary(finished, capsys):
    before = (finished.out / "summary.json").read_bytes()
    study(finished)
    assert "10 of 10 runs were finished before" in capsys.readouterr().err
    assert (finished.out / "summary.json").read_bytes() == before


def test_a_page_without_marks_is_refused_before_anything_runs(tmp_path):
    (tmp_path / "page.md").write_text("no mark")
    with pytest.raises(ValueError, match="no mark"):
        study(StudySettings(out=tmp_path / "out", quote=(tmp_path / "page.md",)))
    assert not (tmp_path / "out").exists()
