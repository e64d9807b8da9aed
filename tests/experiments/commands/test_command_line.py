"""The command as a user meets it: in a process of its own where that matters, else in this one."""

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import shields
from agents.agent import Agent
from experiments.runs.policies import certificate_file
from ncs_gym import truck_trailer
from shields import Certificate
from tests.command import assert_one_sentence, ncs, ncs_process, succeeded
from tests.product import library_plant

ARM_KEYS = {"train_steps", "train_violation_steps", "eval_episodes", "eval_violation_steps", "eval_violating_episodes"}
ARM_KEYS |= {"eval_violation_rate_ci95", "eval_return_mean", "eval_return_ci95", "intervention_rate"}
TRAINED, FIXED = ("unshielded", "shielded"), ("zero-input", "lqr+shielded")
RUNS = 2 * (len(TRAINED) + len(FIXED))


def test_smoke_run_leaves_every_file_of_the_contract(smoke):
    out, run = smoke
    assert "% of the safe box's volume)" in run.prose
    assert "training and evaluation: 100%" in run.stderr
    left = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file() and "tensorboard" not in path.parts}
    expected = {"summary.json", "settings.json", "episodes.parquet", "training.parquet", "report.html"}
    expected |= {"certificate.json"}
    for arm in TRAINED:
        expected |= {f"models/{arm}-{i}/{name}" for i in range(2) for name in ("model.zip", "agent.json")}
    expected |= {f"runs/{name}-{i}.json" for i in range(2) for name in TRAINED + FIXED}
    assert {path for path in left if not path.startswith("figures/")} == expected
    assert {f"figures/{name}.png" for name in ("training", "scatter")} <= left
    assert len(list(out.rglob("events.out.tfevents*"))) == 4


def test_summary_holds_the_keys_of_the_contract_and_adds_up(smoke):
    out, _ = smoke
    summary = json.loads((out / "summary.json").read_text())
    rows = pq.read_table(out / "episodes.parquet").to_pylist()
    assert set(summary["arms"]) == set(TRAINED)
    for name, arm in summary["arms"].items():
        assert set(arm) >= ARM_KEYS
        mine = [row for row in rows if row["arm"] == name]
        assert arm["eval_episodes"] == len(mine) == 10
        assert arm["eval_violation_steps"] == sum(row["violating_steps"] for row in mine)
        assert arm["eval_violating_episodes"] == sum(row["violating"] for row in mine)
        assert arm["eval_return_mean"] == pytest.approx(np.mean([row["return"] for row in mine]))
        assert arm["train_steps"] == 2 * 2048
    shielded, unshielded = summary["arms"]["shielded"], summary["arms"]["unshielded"]
    assert shielded["train_violation_steps"] == shielded["eval_violation_steps"] == 0
    assert shielded["guaranteed_episodes"] == 10
    assert shielded["times_safe_set"] <= 1.0
    assert unshielded["train_violation_steps"] > 0
    assert summary["paired_differences"]["baseline"] == "unshielded"
    assert set(summary["paired_differences"]["arms"]) == {"shielded"}


def test_columns_are_those_of_the_page_and_tables_say_where_they_come_from(smoke):
    page = (Path(__file__).parents[3] / "docs" / "experiments.md").read_text()
    documented = re.findall(r"^\| `(\w+)`", page, re.MULTILINE)
    documented += re.findall(r"`(\w+)`", page.partition("counts since its start:")[2].partition(", for ")[0])
    tables = [pq.read_table(smoke[0] / f"{name}.parquet") for name in ("episodes", "training")]
    assert [name for table in tables for name in table.column_names] == documented
    for table in tables:
        assert set(table["environment"].to_pylist()) == {"ncs_gym/TruckTrailerCruise-v0"}
        assert set(table["algorithm"].to_pylist()) == {"PPO"}
        metadata = json.loads(table.schema.metadata[b"ncs-gym"])
        assert metadata.keys() == {"settings", "seeds", "plant", "certificate", "certificate_file", "versions"}
    summary, episodes = json.loads((smoke[0] / "summary.json").read_text()), tables[0].to_pylist()
    assert metadata.items() <= summary.items()
    assert Certificate.load(smoke[0] / "certificate.json").checksum == summary["certificate"]
    largest = max(row["times_safe_set"] for row in episodes if row["arm"] == "shielded")
    assert f"came to {largest:.3f} times the safe set" in smoke[1].prose


def digests(folder):
    """Contents of all files but those of TensorBoard."""
    files = (path for path in folder.rglob("*") if path.is_file() and "tensorboard" not in path.parts)
    return {path: path.read_bytes() for path in files}


@pytest.mark.parametrize("command", [["compare", "--episodes", 3], ["train", "--steps", 64], ["paper"]])
def test_finished_study_is_not_overwritten(command, smoke):
    out, before = smoke[0], digests(smoke[0])
    assert_one_sentence(ncs(*command, "--out", out), f"{out} holds results of ", "give another --out, or --force")
    assert digests(out) == before


def test_saved_agent_is_evaluated(smoke, tmp_path):
    model = smoke[0] / "models" / "unshielded-0"
    given = ("--shield", "project", "--episodes", "5", "--channel", "loss=0.9", "--out", tmp_path / "e.json")
    run = succeeded("evaluate", model, *given)
    left = json.loads((tmp_path / "e.json").read_text())
    arm = left["arms"]["shield: project"]
    assert (arm["eval_episodes"], arm["eval_violation_steps"], arm["guaranteed_episodes"]) == (5, 0, 5)
    assert (left["channel"]["loss"], left["channel"]["delay"]) == (0.9, 2)
    assert " 0.0 [0.0, 52.2] " in run.stdout


def test_one_agent_is_trained(tmp_path, without_workers):
    small = ("--steps", 64, "--episodes", 2, "--hyperparams", "n_envs=8")
    run = succeeded("train", "--algorithms", "A2C", *small, "--out", tmp_path / "one")
    model = tmp_path / "one" / "models" / "shielded-0"
    assert f"agent: {model}" in run.stdout
    summary = json.loads((tmp_path / "one" / "summary.json").read_text())
    assert summary["arms"]["shielded"]["train_violation_steps"] == 0
    assert Agent.load(model).algorithm == "A2C"
    evaluated = succeeded("evaluate", model / "model.zip", "--episodes", "2")  # beside what the agent is known by
    assert "shield: project" in evaluated.stdout


@pytest.mark.slow
def test_sweep_leaves_its_files_and_goes_on_where_it_was(tmp_path, without_workers):
    out = tmp_path / "sweep"
    grid = ["--losses", "0.5", "0.6", "--delays", "1", "--channel", "send_period=1", "--episodes", "3"]
    grid += ["--steps", "256", "--arms", "shielded", "lqr", "--seeds", "1"]
    given = ("--hyperparams", "n_envs=4", "n_steps=64", "--out", out)
    succeeded("sweep", *grid, *given)
    summary = json.loads((out / "summary.json").read_text())
    assert [(cell["loss"], cell["delay"]) for cell in summary["cells"]] == [(0.5, 1), (0.6, 1)]
    assert all(cell["arms"]["shielded"]["eval_violation_steps"] == 0 for cell in summary["cells"])
    rows = pq.read_table(out / "episodes.parquet").to_pylist()
    assert len(rows) == 4 * 3
    assert {"arm", "run", "violating"} <= set(rows[0])
    assert {(row["loss"], row["delay"]) for row in rows} == {(0.5, 1), (0.6, 1)}
    assert {row["arm"] for row in pq.read_table(out / "training.parquet").to_pylist()} == {"shielded"}
    evaluated = succeeded("evaluate", out / "models" / "loss0.6-delay1-shielded-0", "--episodes", 3)
    assert "The guarantee held after 600 of 600 steps." in evaluated.prose
    assert not (out / "report.html").exists()
    other = ncs("sweep", *grid, *given, "--seed", "1")
    assert_one_sentence(other, "of other settings (seed 0, now 1)", "--force")
    (out / "runs" / "loss0.6-delay1-lqr-0.json").unlink()
    assert "3 of 4 runs were finished before" in succeeded("sweep", *grid, *given).stderr
    assert json.loads((out / "summary.json").read_text()) == summary


def test_certificate_of_an_agent_is_that_beside_it_then_that_of_its_run(tmp_path):
    agent, single = tmp_path / "models" / "loss0.2-delay1-shielded-0", tmp_path / "agent"
    for folder in (agent, single):
        folder.mkdir(parents=True)
    assert certificate_file(agent) is certificate_file(single) is None
    for file in (tmp_path / "certificate.json", agent / "certificate.json"):
        file.touch()
        assert certificate_file(agent) == file
        assert certificate_file(tmp_path / "models" / "other-0") == tmp_path / "certificate.json"
    assert certificate_file(single) is None


def test_synthesize_then_verify(tmp_path):
    file = tmp_path / "c.json"
    made = succeeded("synthesize", "--env", "ncs_gym/TruckTrailer-v0", "--out", file)
    checked = succeeded("verify", file, "--out", tmp_path / "report.json")
    assert made.stdout.endswith(f"saved to {file}\n")
    assert checked.stdout.endswith(f"{file} verifies\n")
    assert json.loads((tmp_path / "report.json").read_text())["valid"] is True
    other = ncs("verify", file, "--env", "ncs_gym/TruckTrailerCruise-v0")
    assert_one_sentence(other, "does not verify: it was made for another plant")
    assert "set points coupling stretch from -0.8" in checked.prose.partition("What can be held:")[2]
    exceeded = ncs("verify", Path(shields.__file__).parent / "packaged_certificates" / "Pendulum-v0.json").prose
    assert "until the newest is 3 steps (150 ms) old" in exceeded.partition("Beyond")[2]


def test_command_does_the_same_in_this_process_and_in_one_of_its_own(tmp_path):
    own = ncs_process("fly", cwd=tmp_path)
    assert ncs("fly", cwd=tmp_path) == (own.returncode, own.stdout, own.stderr)


def test_infeasible_problem_is_one_sentence(tmp_path):
    library_plant(truck_trailer, disturbance_bound=3.0).save(tmp_path / "plant.json")
    run = ncs("synthesize", "--plant", "plant.json", cwd=tmp_path)
    assert run.returncode == 2
    assert run.stderr.splitlines()[-1].startswith("ncs: (I) no invariant set within the limits was found")
    assert [path.name for path in tmp_path.iterdir()] == ["plant.json"]


def test_damaged_and_foreign_certificates_are_one_sentence(certificate, tmp_path):
    certificate.save(tmp_path / "c.json")
    text = (tmp_path / "c.json").read_text()
    (tmp_path / "cut.json").write_text(text[: len(text) // 2])
    (tmp_path / "changed.json").write_text(text.replace('"fingerprint": "', '"fingerprint": "0', 1))
    assert_one_sentence(ncs("verify", tmp_path / "cut.json"), "not valid JSON")
    assert_one_sentence(ncs("verify", tmp_path / "changed.json"), "altered")
    foreign = ["compare", "--env", "ncs_gym/TruckTrailer-v0", "--certificate", tmp_path / "c.json"]
    assert_one_sentence(ncs(*foreign, "--out", tmp_path / "out"), "another plant")
    assert not (tmp_path / "out").exists()
