import json
from dataclasses import replace

import numpy as np
import pytest

from agents.settings import PPOSettings
from experiments.backends.execution import results_of
from experiments.errors import ResultsError
from experiments.runs.run_store import UnitStore
from experiments.runs.training_run import Unit, run_unit
from experiments.settings.backend import EngineSettings


@pytest.fixture(scope="module")
def unit(certificate):
    return Unit(
        arm="shielded:switch+penalty",
        learner="agent",
        env="ncs_gym/TruckTrailerCruise-v0",
        seed=0,
        index=1,
        steps=256,
        episodes=2,
        certificate=certificate,
        mode="switch",
        algorithm="PPO",
        settings=PPOSettings(envs=2, rollout=64, batch_size=64, epochs=1, width=8),
    )


@pytest.fixture(scope="module")
def result(unit):
    return run_unit(unit, lambda steps: None)


@pytest.fixture
def store(tmp_path, unit, result):
    store = UnitStore(tmp_path)
    store.save(unit, result)
    return store


def test_stored_result_comes_back_exactly(store, unit, result):
    again = store.load(unit)
    assert again.episodes == result.episodes
    assert repr(again.history) == repr(result.history)  # NaN equals nothing, itself included
    assert again.files == result.files
    for name, array in vars(result.trajectory).items():
        np.testing.assert_array_equal(getattr(again.trajectory, name), array)
        assert getattr(again.trajectory, name).dtype == array.dtype


@pytest.mark.parametrize(
    "change",
    [{"seed": 1}, {"steps": 257}, {"mode": "project"}, {"settings": PPOSettings()}, {"violation_penalty": 0.5}],
)
def test_result_of_other_settings_is_not_taken(store, unit, change):
    assert store.load(replace(unit, **change)) is None


def test_result_of_another_certificate_or_version_is_not_taken(store, unit, certificate, monkeypatch):
    other = replace(certificate, provenance=certificate.provenance | {"note": "other"})
    assert store.load(replace(unit, certificate=other)) is None
    monkeypatch.setattr("experiments.runs.training_run.versions", lambda: {"torch": "0"})
    assert store.load(unit) is None


def test_place_in_a_sweep_is_no_part_of_the_settings(unit):
    assert replace(unit, place="loss0.3").key == unit.key
    assert replace(unit, place="loss0.3").name == "loss0.3-shielded-switch+penalty-1"


def test_damaged_results_are_one_sentence(store, unit, tmp_path):
    path = tmp_path / "units" / f"{unit.name}.json"
    text = path.read_text()
    for damaged in ("", "{", "[]", text[: len(text) // 2], text.replace('"index": 1', '"index": 0', 1)):
        path.write_text(damaged)
        with pytest.raises(ResultsError, match="delete it to run the unit again"):
            store.load(unit)


def test_result_without_its_agent_is_refused(store, unit, tmp_path):
    (tmp_path / "models" / unit.name / "model.zip").write_bytes(b"other")
    with pytest.raises(ResultsError, match="missing or was altered"):
        store.load(unit)


def test_half_stored_result_of_other_settings_leaves_nothing_behind(store, unit, result, monkeypatch):
    # Killed between the agent's files and the unit's.
    def killed(path, content):
        if path.suffix == ".json" and path.parent.name == "units":
            raise KeyboardInterrupt
        path.write_bytes(content)

    monkeypatch.setattr("experiments.runs.run_store.write_atomically", killed)
    with pytest.raises(KeyboardInterrupt):
        store.save(replace(unit, steps=257), replace(result, files={"model.zip": b"new", "agent.json": b"new"}))
    assert store.load(unit) is None


def test_changed_source_is_another_key(unit, monkeypatch):
    before = unit.key
    monkeypatch.setattr("experiments.runs.provenance._source_digest", lambda: "changed")
    assert unit.key != before


def test_units_of_one_name_are_refused(unit, tmp_path):
    with pytest.raises(ValueError, match="same name"):
        results_of([unit, unit], tmp_path, EngineSettings(jobs=1))


def test_nothing_stored_is_nothing_loaded(unit, tmp_path):
    assert UnitStore(tmp_path).load(unit) is None


def test_stored_file_is_data_only(store, unit, tmp_path):
    document = json.loads((tmp_path / "units" / f"{unit.name}.json").read_text())
    assert document["key"] == unit.key
    assert set(document["result"]["files"]) == {"model.zip", "agent.json"}


def test_finished_units_are_not_run_again(store, unit, result, tmp_path, monkeypatch, capsys):
    ran = []

    def record(units, jobs, total_steps, on_result, log_folder):
        for one in units:
            ran.append(one.name)
            on_result(one, replace(result, index=one.index))

    monkeypatch.setattr("experiments.backends.processes.run_all", record)
    missing = replace(unit, index=2)
    results = results_of([unit, missing], tmp_path, EngineSettings(jobs=1))
    assert ran == [missing.name]
    assert [one.index for one in results] == [1, 2]
    assert [one.files for one in results] == [{}, {}]  # those of many units would fill the memory
    assert "1 of 2 units were finished before" in capsys.readouterr().err
    results_of([missing, unit], tmp_path, EngineSettings(jobs=1))
    assert ran == [missing.name]
