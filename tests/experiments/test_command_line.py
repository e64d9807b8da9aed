"""The command as a user meets it: a subprocess."""

import json
import os
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest

from shields import Certificate, verify

ARM_KEYS = {
    "train_steps",
    "train_violation_steps",
    "eval_episodes",
    "eval_violation_steps",
    "eval_violating_episodes",
    "eval_violation_rate_ci95",
    "eval_return_mean",
    "eval_return_ci95",
    "intervention_rate",
}


def ncs(*arguments, cwd=None, **environment):
    command = [sys.executable, "-m", "experiments", *map(str, arguments)]
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    env = os.environ | {"PYTHONPATH": path} | environment
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=env, timeout=300)


def assert_one_sentence(run, *words):
    assert run.returncode == 2, run.stderr
    assert "Traceback" not in run.stderr
    lines = run.stderr.strip().splitlines()
    assert len(lines) == 1, run.stderr
    assert lines[0].startswith("ncs: ")
    assert all(word in lines[0] for word in words), lines[0]


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    folder = tmp_path_factory.mktemp("smoke")
    return folder / "out", ncs("compare", "--smoke", "--out", folder / "out")


def test_smoke_run_leaves_every_file_of_the_contract(smoke):
    out, run = smoke
    assert run.returncode == 0, run.stderr
    left = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file() and "tensorboard" not in path.parts}
    expected = {"summary.json", "episodes.parquet", "report.html", "certificate.json"}
    expected |= {f"figures/{name}.png" for name in ("training", "phase", "episode")}
    for arm in ("shielded", "unshielded"):
        expected |= {f"models/{arm}-{i}/{name}" for i in range(2) for name in ("model.zip", "normalizer.pkl")}
    assert left == expected
    assert len(list(out.rglob("events.out.tfevents*"))) == 4


def test_summary_holds_the_keys_of_the_contract_and_adds_up(smoke):
    out, _ = smoke
    summary = json.loads((out / "summary.json").read_text())
    rows = pq.read_table(out / "episodes.parquet").to_pylist()
    assert set(summary["arms"]) == {"unshielded", "shielded"}
    for name, arm in summary["arms"].items():
        assert set(arm) >= ARM_KEYS
        mine = [row for row in rows if row["arm"] == name]
        assert arm["eval_episodes"] == len(mine) == 20
        assert arm["eval_violation_steps"] == sum(row["violation_steps"] for row in mine)
        assert arm["eval_violating_episodes"] == sum(row["violation_steps"] > 0 for row in mine)
        assert arm["eval_return_mean"] == pytest.approx(np.mean([row["episode_return"] for row in mine]))
        assert arm["train_steps"] == 2 * 4096
    shielded, unshielded = summary["arms"]["shielded"], summary["arms"]["unshielded"]
    assert shielded["train_violation_steps"] == shielded["eval_violation_steps"] == 0
    assert shielded["guaranteed_episodes"] == 20
    assert shielded["largest_level"] <= 1.0
    assert unshielded["train_violation_steps"] > 0
    seeds = {name: [row["seed"] for row in rows if row["arm"] == name] for name in summary["arms"]}
    assert seeds["shielded"] == seeds["unshielded"]


def test_smoke_run_prints_the_table_and_the_files(smoke):
    out, run = smoke
    assert "shielded" in run.stdout
    assert "violating episodes" in run.stdout
    assert str(out) in run.stdout
    assert "step/s" in run.stderr


def test_report_is_one_self_contained_page(smoke):
    out, _ = smoke
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 3
    assert "http://" not in page
    assert "https://" not in page
    assert "(E1) Sigma - A Sigma A&#x27;/lam_e" in page


def test_saved_certificate_verifies(smoke, loaded):
    out, _ = smoke
    assert verify(Certificate.load(out / "certificate.json"), loaded).valid


def test_same_settings_give_the_same_summary(smoke, tmp_path):
    out, _ = smoke
    again = ncs("compare", "--smoke", "--out", tmp_path / "out")
    assert again.returncode == 0, again.stderr
    first, second = (json.loads((folder / "summary.json").read_text()) for folder in (out, tmp_path / "out"))
    assert first["arms"] == second["arms"]
    assert first["references"] == second["references"]


def test_synthesize_then_verify(tmp_path):
    file = tmp_path / "c.json"
    made = ncs("synthesize", "--env", "ncs_gym/TruckTrailer-v0", "--out", file)
    assert made.returncode == 0, made.stderr
    checked = ncs("verify", file, "--out", tmp_path / "report.json")
    assert checked.returncode == 0, checked.stderr
    assert checked.stdout.strip().endswith("valid")
    assert json.loads((tmp_path / "report.json").read_text())["valid"] is True
    other = ncs("verify", file, "--env", "ncs_gym/TruckTrailerCruise-v0")
    assert_one_sentence(other, "does not verify")


@pytest.mark.parametrize("command", ["compare", "synthesize", "verify", "audit", "reproduce", "render"])
def test_every_command_has_help_seed_and_out(command):
    run = ncs(command, "--help")
    assert run.returncode == 0
    assert "--seed" in run.stdout
    assert "--out" in run.stdout


@pytest.mark.parametrize(
    "arguments", [[], ["fly"], ["compare", "--mode", "hope"], ["compare", "--steps", "many"], ["verify"]]
)
def test_usage_errors_are_the_parsers(arguments):
    run = ncs(*arguments)
    assert run.returncode == 2
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["compare", "--env", "CartPole-v1"], ["unknown environment 'CartPole-v1'", "ncs_gym/TruckTrailerCruise-v0"]),
        (["compare", "--env", "ncs_gym/LinearNCS-v0"], ["unknown environment"]),
        (["compare", "--steps", "0"], ["--steps must be at least 1"]),
        (["compare", "--jobs", "-1"], ["--jobs must be at least 1"]),
        (["compare", "--seed", "-1"], ["--seed must be >= 0"]),
        (["compare", "--penalty", "nan"], ["--penalty must be >= 0"]),
        (
            ["synthesize", "--env", "ncs_gym/TruckTrailer-v0", "--method", "paper"],
            ["OP is infeasible", "(C2) binds", "0.034"],
        ),
        (["compare", "--certificate", "nowhere.json"], ["cannot read certificate nowhere.json"]),
        (["verify", "nowhere.json"], ["cannot read certificate nowhere.json"]),
        (["synthesize", "--out", "no/such/folder/c.json"], ["No such file or directory"]),
    ],
)
def test_other_errors_are_one_sentence(arguments, words, tmp_path):
    assert_one_sentence(ncs(*arguments, cwd=tmp_path), *words)
    assert list(tmp_path.iterdir()) == [] or not any(tmp_path.rglob("*.json"))


def test_unwritable_output_is_one_sentence_and_leaves_nothing(tmp_path):
    (tmp_path / "file").write_text("mine")
    assert_one_sentence(ncs("compare", "--smoke", "--out", tmp_path / "file"), "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_damaged_and_foreign_certificates_are_one_sentence(certificate, tmp_path):
    certificate.save(tmp_path / "c.json")
    text = (tmp_path / "c.json").read_text()
    (tmp_path / "cut.json").write_text(text[: len(text) // 2])
    (tmp_path / "changed.json").write_text(text.replace("0.7590557", "0.7590558", 1))
    assert_one_sentence(ncs("verify", tmp_path / "cut.json"), "not valid JSON")
    assert_one_sentence(ncs("verify", tmp_path / "changed.json"), "altered")
    foreign = ["compare", "--env", "ncs_gym/TruckTrailer-v0", "--certificate", tmp_path / "c.json"]
    assert_one_sentence(ncs(*foreign, "--out", tmp_path / "out"), "another plant")
    assert not (tmp_path / "out").exists()
