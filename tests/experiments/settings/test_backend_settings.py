import sys

import pytest

from experiments.__main__ import COMMANDS, _run
from experiments.runs.experiment import INCIDENTAL_SETTINGS
from experiments.runs.training_run import TrainingRun
from experiments.settings import BackendSettings
from experiments.settings.learning import CompareSettings, SweepSettings


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"jobs": 0}, "--jobs must be at least 1"),
        ({"engine": "ray", "ray_address": "head"}, "--ray-address must be local, auto or HOST:PORT, got 'head'"),
        ({"engine": "ray", "ray_address": "ray://head:10001"}, "--ray-address must be"),
        ({"engine": "ray", "ray_address": ""}, "--ray-address must be"),
        ({"engine": "ray", "ray_wait": -1.0}, "--ray-wait must be at least 0"),
        ({"engine": "ray", "ray_wait": float("inf")}, "--ray-wait must be at least 0"),
        ({"engine": "ray", "cpus_per_run": 0.0}, "--cpus-per-run must be at least"),
        ({"engine": "ray", "cpus_per_run": float("nan")}, "--cpus-per-run must be at least"),
        ({"engine": "ray", "gpus_per_run": -1.0}, "--gpus-per-run must be"),
        ({"engine": "ray", "gpus_per_run": 1.5}, r"--gpus-per-run must be in \[0, 1\] or a whole number"),
        ({"engine": "ray", "gpus_per_run": float("inf")}, "--gpus-per-run must be"),
        ({"ray_address": "auto"}, "--ray-address is a setting of --engine ray"),
        ({"cpus_per_run": 2.0}, "--cpus-per-run is a setting of --engine ray"),
        ({"gpus_per_run": 1.0}, "--gpus-per-run is a setting of --engine ray"),
        ({"ray_wait": 1.0}, "--ray-wait is a setting of --engine ray"),
    ],
)
@pytest.mark.parametrize("kind", [BackendSettings, CompareSettings, SweepSettings])
def test_impossible_settings_are_refused(kind, change, words):
    with pytest.raises(ValueError, match=words):
        kind(**change)


@pytest.mark.parametrize("address", ["local", "auto", "head:6379", "my-head.example:6379", "[::1]:1"])
def test_addresses_of_clusters_are_taken(address):
    assert BackendSettings(engine="ray", ray_address=address, gpus_per_run=0.25, cpus_per_run=0.5).jobs == 2


@pytest.mark.parametrize("kind", [CompareSettings, SweepSettings])
def test_settings_of_learning_are_still_checked(kind):
    with pytest.raises(ValueError, match="--steps must be at least 1"):
        kind(steps=0)


@pytest.mark.parametrize("kind", [CompareSettings, SweepSettings])
def test_ray_missing_is_one_sentence_that_says_what_to_install(kind, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    with pytest.raises(ModuleNotFoundError, match=r"this command needs ray: .* pip install -e '.\[ray\]'"):
        _run(kind(engine="ray", out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_results_of_every_engine_have_the_same_key_and_provenance():
    # A unit does not know its engine, and a summary leaves it out: a sweep begun with one can be finished with another.
    names = set(BackendSettings.__dataclass_fields__)
    assert names
    assert not names & set(TrainingRun.__dataclass_fields__)
    assert names < set(INCIDENTAL_SETTINGS)


def test_engines_are_offered_by_the_commands_with_many_runs():
    kinds = {"compare": CompareSettings, "sweep": SweepSettings}
    assert {name for name in COMMANDS if issubclass(kinds.get(name, object), BackendSettings)} == {"compare", "sweep"}
