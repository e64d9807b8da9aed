import json
from dataclasses import replace

import pytest

from agents.loop import LagrangianSettings
from experiments.backends.execution import load, results_of, save
from experiments.baselines.filters import EstimateFilterSettings
from experiments.runs.provenance import versions
from experiments.settings import BackendSettings
from tests.experiments.results import training_run


@pytest.fixture(scope="module")
def run(certificate):
    return training_run(certificate, "switch", arm="shielded:switch+penalty", index=1)


@pytest.fixture(scope="module")
def result(run):
    return run.execute(lambda steps: None)


@pytest.fixture
def folder(tmp_path, run, result):
    save(tmp_path, run, result)
    return tmp_path


def test_stored_result_comes_back_exactly(folder, run, result):
    again = load(folder, run)
    models = folder / "models" / run.name
    assert again.episodes == result.episodes
    assert repr(again.history) == repr(result.history)  # NaN equals nothing, itself included
    assert {path.name: path.read_bytes() for path in models.iterdir()} == again.files == result.files


def test_stored_result_is_not_made_again(folder, run, result, monkeypatch, capsys):
    monkeypatch.setattr(type(run), "execute", None)
    (again,) = results_of([run], folder, BackendSettings(jobs=1))
    assert again.episodes == result.episodes
    assert "1 of 1 runs were finished before" in capsys.readouterr().err


def test_result_of_anything_else_is_not_taken(folder, run, certificate, monkeypatch):
    changes = [{"seed": 1}, {"steps": 257}, {"settings": {}}, {"scenarios": ("gaussian",)}]
    changes.append({"certificate": replace(certificate, provenance=certificate.provenance | {"note": "other"})})
    loops = [{"violation_penalty": 0.5}, {"kwargs": {"noise": "gaussian"}}, {"lagrangian": LagrangianSettings()}]
    loops += [{"kwargs": {"channel": {"loss": {"p_good_to_bad": 0.1, "p_bad_to_good": 0.5}}}}, {"shield": None}]
    loops += [{"shield": None, "filter": EstimateFilterSettings("psf", certificate)}]
    shields = ({"mode": "project"}, {"penalty": 0.5}, {"mode": "lookahead", "horizon": 4})
    loops += [{"shield": replace(run.loop.shield, **change)} for change in shields]
    changes += [{name: replace(getattr(run, name), **each)} for name in ("loop", "training_loop") for each in loops]
    assert [change for change in changes if load(folder, replace(run, **change)) is not None] == []
    monkeypatch.setattr("experiments.runs.training_run.versions", lambda: versions() | {"source": "changed"})
    assert load(folder, run) is None


@pytest.mark.parametrize("content", [b"{", b"[]", b"\xff", b"[" * 10_000, None])
def test_damaged_result_is_said_and_done_again(folder, run, content, capsys):
    path = folder / "runs" / f"{run.name}.json"
    document = json.loads(path.read_bytes())
    del document["result"]["episodes"]
    path.write_bytes(json.dumps(document).encode() if content is None else content)
    assert load(folder, run) is None
    assert f"{run.name}.json is damaged: its run is done again" in capsys.readouterr().err


def test_result_without_its_agent_is_done_again(folder, run):
    (folder / "models" / run.name / "model.zip").unlink()
    assert load(folder, run) is None


def test_runs_of_one_name_are_refused(run, tmp_path):
    alike = replace(run, grid_point="loss 0.3"), replace(run, grid_point="loss/0.3")
    for runs in ((run, run), alike):
        with pytest.raises(ValueError, match="same name"):
            results_of(runs, tmp_path, BackendSettings(jobs=1))
