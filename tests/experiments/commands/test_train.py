"""What `ncs train` says of its training."""

import json

import pytest

from tests.command import ncs

SMALL = ("n_envs=8", "n_steps=64", "batch_size=64")
HINT = "This training had no violation and no override"


@pytest.mark.parametrize(
    ("arm", "log_std", "happens"),
    [
        ("shielded", -4.0, set()),
        ("unshielded", -4.0, set()),
        ("shielded", 1.0, {"train_intervention_rate"}),
        ("unshielded", 1.0, {"train_violation_steps"}),
    ],
)
def test_hint_follows_exactly_the_trainings_in_which_nothing_happened(tmp_path, without_workers, arm, log_std, happens):
    networks = f"policy_kwargs=dict(net_arch=[8, 8], log_std_init={log_std})"
    short = ("--steps", 512, "--episodes", 1, "--hyperparams", *SMALL, networks)
    run = ncs("train", "--arm", arm, *short, "--out", tmp_path / "r")
    assert run.returncode == 0, run.stderr
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())["arms"][arm]
    assert {name for name in ("train_violation_steps", "train_intervention_rate") if summary[name]} == happens
    prose = " ".join(run.stdout.split())
    assert (HINT in prose) is (not happens)
    assert ("raise --steps, or run `ncs compare`" in prose) is (not happens)


def test_hint_of_a_smoke_run_names_the_flag_that_keeps_it_short(tmp_path, without_workers):
    networks = "policy_kwargs=dict(net_arch=[8, 8], log_std_init=-4.0)"
    run = ncs("train", "--smoke", "--hyperparams", *SMALL, networks, "--out", tmp_path / "r")
    assert run.returncode == 0, run.stderr
    assert f"{HINT}, so it does not show what the shield is for: leave out --smoke" in " ".join(run.stdout.split())
    assert run.stdout.splitlines()[-1].startswith("agent: ")
