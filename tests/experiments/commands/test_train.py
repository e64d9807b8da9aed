"""What `ncs train` says of its training."""

import json
from dataclasses import replace

import pytest

from agents import Agent, SafetyCallback
from experiments.__main__ import parse
from experiments.errors import RunStopped
from experiments.runs.output_folder import claim_folder
from tests.command import assert_one_sentence, ncs, succeeded

SMALL = ("n_envs=8", "n_steps=64", "batch_size=64")
HINT = "This training had no violation and no override"


@pytest.mark.cases(1)
@pytest.mark.parametrize(
    ("arm", "log_std", "happens"),
    [
        ("unshielded", -4.0, set()),
        ("shielded", 1.0, {"train_intervention_rate"}),
        ("unshielded", 1.0, {"train_violation_steps"}),
    ],
)
def test_hint_follows_exactly_the_trainings_in_which_nothing_happened(tmp_path, without_workers, arm, log_std, happens):
    networks = f'policy_kwargs={{"net_arch": [8, 8], "log_std_init": {log_std}}}'
    short = ("--steps", 512, "--episodes", 1, "--hyperparams", *SMALL, networks)
    run = succeeded("train", "--arm", arm, *short, "--out", tmp_path / "r")
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())["arms"][arm]
    assert {name for name in ("train_violation_steps", "train_intervention_rate") if summary[name]} == happens
    prose = run.prose
    assert (HINT in prose) is (not happens)
    assert ("raise --steps, or run `ncs compare`" in prose) is (not happens)


SHORT = ("--episodes", 1, "--hyperparams", *SMALL, 'policy_kwargs={"net_arch": [8, 8]}', "--out")


def test_interrupted_training_goes_on_where_it_was(tmp_path, without_workers, monkeypatch):
    folder, add_point = tmp_path / "r", SafetyCallback.add_point

    def interrupt(callback):
        add_point(callback)
        if callback.num_timesteps >= 1024:
            raise RunStopped("the user interrupted")

    monkeypatch.setattr(SafetyCallback, "add_point", interrupt)
    assert ncs("train", "--steps", 2048, *SHORT, folder).returncode == 2
    monkeypatch.undo()
    checkpoint = folder / "tensorboard" / "shielded-0" / "checkpoint"
    assert Agent.load(checkpoint).model.num_timesteps == 0  # nothing but weights is read of a model
    assert_one_sentence(ncs("train", "--steps", 1024, *SHORT, folder), "steps 2048, now 1024")
    run = ncs("train", "--steps", 2048, *SHORT, folder)
    assert "goes on after 1,024 steps" in run.stdout
    assert [point["steps"] for point in stored(folder)["history"]] == [512, 1024, 1536, 2048]
    assert not checkpoint.exists()


@pytest.mark.parametrize("text", ["[", "[3]", '[{"steps": 1}]', '{"steps": 512}'])
def test_damaged_history_is_one_sentence(tmp_path, without_workers, text):
    folder = tmp_path / "r"
    checkpoint = folder / "tensorboard" / "shielded-0" / "checkpoint"
    checkpoint.mkdir(parents=True)
    (checkpoint / "history.json").write_text(text)
    settings = replace(parse(["train", "--steps", "512", *map(str, SHORT), str(folder)]), force=True)
    claim_folder("train", settings.completed)
    run = ncs("train", "--steps", 512, *SHORT, folder)
    assert_one_sentence(run, "no training can go on from", "--force")


def stored(folder):
    return json.loads((folder / "runs" / "shielded-0.json").read_text())["result"]
