"""What `ncs train` says of its training."""

import json

import pytest

from tests.command import succeeded

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
