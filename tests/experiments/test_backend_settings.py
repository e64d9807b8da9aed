import sys

import pytest

from experiments.commands.compare import CompareSettings
from experiments.runs.training_run import TrainingRun
from experiments.settings import BackendSettings, lasting_settings
from tests.command import assert_one_sentence, ncs


@pytest.mark.parametrize("command", ["compare", "sweep"])
def test_ray_missing_is_one_sentence_that_says_what_to_install(command, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    run = ncs(command, "--engine", "ray", "--out", tmp_path / "out")
    assert_one_sentence(run, "this command needs ray: ", "pip install -e '.[ray]'")
    assert not (tmp_path / "out").exists()


def test_results_of_every_engine_have_the_same_key_and_provenance():
    # A unit does not know its engine, and a summary leaves it out: a sweep begun with one can be finished with another.
    names = set(BackendSettings.__dataclass_fields__)
    assert names
    assert not names & set(TrainingRun.__dataclass_fields__)
    assert not names & lasting_settings(CompareSettings()).keys()
