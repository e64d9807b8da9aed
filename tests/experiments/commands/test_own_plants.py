"""Commands for a user's own plant: `--env module:id` and `--plant FILE`."""

import json
import sys

import gymnasium as gym
import pytest

from agents.hyperparams import complete_hyperparams
from ncs_gym import truck_trailer
from shields import Certificate
from tests.command import assert_one_sentence, ncs, succeeded, without_pictures
from tests.verdicts import verified

MODULE = """
from ncs_gym import Channel, register_plant, truck_trailer

register_plant("Plants/Truck-v0", truck_trailer(mass=2000.0), channel=Channel(loss=0.2), max_episode_steps=20)
"""


TANK = """
from ncs_gym import Ball, Bounds, Channel, Limits, LinearPlant, Model, contract_of, register_plant

# Limits with two ends, far from symmetric about the operating point.
A, B = [[0.9, 0.0], [0.095, 0.92]], [[0.114], [0.006]]
plant = LinearPlant(
    Model(A, B, None, dt=2.0, at=([3.0, 3.5], [2.6])),
    Limits(state=([0.5, 0.5], [4.0, 6.0]), input=(0.0, 8.0)),
    Bounds(Ball(0.01), Ball(0.01), Ball(0.05)),
)
channel = Channel(loss=0.3, max_consecutive_losses=2)
register_plant("Plants/Tank-v0", plant, channel=channel, contract=contract_of(channel), max_episode_steps=20)
"""


TASK = """
from ncs_gym import Channel, Task, register_plant, truck_trailer


class Far(Task):
    def reward(self, plant, task_state, state, u):
        return float(abs(state[0]))


register_plant("Plants/Far-v0", truck_trailer(mass=2000.0), channel=Channel(loss=0.2), task=Far(), max_episode_steps=20)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with modules that register a plant each; neither they nor the ids outlive the test."""
    (tmp_path / "own_plants.py").write_text(MODULE)
    (tmp_path / "own_tank.py").write_text(TANK)
    (tmp_path / "own_task.py").write_text(TASK)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for module, env_id in {"own_plants": "Plants/Truck-v0", "own_tank": "Plants/Tank-v0"}.items():
        sys.modules.pop(module, None)
        gym.registry.pop(env_id, None)


ENV = ("--env", "own_plants:Plants/Truck-v0")


def test_baselines_that_do_not_know_what_an_own_task_asks_for_are_left_out_or_refused(folder, without_workers):
    env = ("compare", "--env", "own_task:Plants/Far-v0", "--seeds", "1", "--episodes", "2")
    with without_pictures():
        run = succeeded(*env, "--arms", "random", cwd=folder)
    rows = [line.split("  ")[0].strip() for line in run.stdout.splitlines()]
    assert {"random", "K x_hat", "zero input", "untrained"} <= set(rows)
    assert "lqr" not in run.stdout
    assert "without lqr, lqr+trusting, lqr+shielded: " in " ".join(run.stderr.split())
    refused = ncs(*env, "--arms", "lqr+shielded", "--baselines", "random", "--out", "refused", cwd=folder)
    assert_one_sentence(refused, "arm lqr+shielded: lqr does not know what a Far asks for")


def test_certificate_for_a_registered_plant_is_made_and_verified(folder):
    run = succeeded("synthesize", *ENV, cwd=folder)
    assert "% of the safe box's volume" in run.stdout
    certificate = Certificate.load(folder / "certificate.json")
    assert verified(certificate, truck_trailer(mass=2000.0)).valid
    assert ncs("verify", "certificate.json", *ENV, cwd=folder).stdout.endswith("\ncertificate.json verifies\n")
    assert_one_sentence(ncs("verify", "certificate.json", "--env", "ncs_gym/TruckTrailer-v0", cwd=folder), "verify")


def test_own_plant_is_attacked_on_its_channel_and_without_any_packet(folder, monkeypatch):
    monkeypatch.setattr("experiments.commands.attack.EPISODE_STEPS", 20)
    succeeded("attack", *ENV, "--steps", 1, "--out", "c.json", cwd=folder)
    document = json.loads((folder / "c.json").read_text())
    assert list(document) == ["Plants/Truck-v0, own", "Plants/Truck-v0, blackout"]
    for counts in document.values():
        assert counts["steps"] == 8 * 20
        assert counts["outside S"] == counts["no claim"] == 0
        assert counts["overridden"] > 0
    assert_one_sentence(ncs("attack", "--env", "own_plants:Plants/Other-v0", cwd=folder), "Plants/Other-v0")


def test_arms_with_and_without_training_are_compared_where_limits_have_two_ends(folder, without_workers):
    tank, short = ("--env", "own_tank:Plants/Tank-v0"), ("--seeds", 1, "--episodes", 2, "--steps", 32)
    small = ("--hyperparams", "n_steps=16", "n_envs=2", "batch_size=32", "n_epochs=1")
    arms = ("unshielded", "shielded")
    baselines = ("zero input", "K x_hat", "random", "lqr+shielded", "lqr+psf:20", "mpc")
    with without_pictures():
        run = ncs(
            "compare", *tank, *short, *small, "--arms", *arms, "--baselines", *baselines, "--out", "c", cwd=folder
        )
    assert run.returncode == 0, run.stderr
    arms = json.loads((folder / "c" / "summary.json").read_text())
    assert set(arms["references"]) == set(baselines)
    assert arms["arms"]["shielded"]["eval_violation_steps"] == 0
    assert (folder / "c" / "figures" / "scatter.png").is_file()


@pytest.mark.slow
def test_own_plant_is_trained_in_and_evaluated_by_its_id(folder, without_workers):
    short = ("--steps", 64, "--episodes", 2, "--hyperparams", "n_steps=16", "n_envs=2")
    run = succeeded("train", *ENV, *short, "--out", "r", cwd=folder)
    settings = json.loads((folder / "r" / "settings.json").read_text())
    assert settings["settings"]["env"] == "Plants/Truck-v0"  # a file names no module
    assert settings["settings"]["hyperparams"] == complete_hyperparams("PPO", dict(n_steps=16, n_envs=2))
    assert "PPO, default hyperparameters, as given n_envs, n_steps:" in run.stdout
    model = next((folder / "r" / "models").iterdir())
    assert json.loads((model / "agent.json").read_text())["env"] == "Plants/Truck-v0"
    succeeded("evaluate", model, *ENV, "--episodes", 2, cwd=folder)
    other = ncs("evaluate", model, "--env", "ncs_gym/TruckTrailer-v0", cwd=folder)
    assert_one_sentence(other, "was trained in Plants/Truck-v0, not in ncs_gym/TruckTrailer-v0")
    gym.registry.pop("Plants/Truck-v0")
    del sys.modules["own_plants"]
    unknown = ncs("evaluate", model, cwd=folder)  # in a process that does not know the module
    assert_one_sentence(unknown, "on the command line give --env module:id, with the name of that module")


def test_error_of_the_module_itself_is_told(folder):
    (folder / "own_plants.py").write_text("import something_that_is_missing")
    assert_one_sentence(ncs("synthesize", *ENV, cwd=folder), "something_that_is_missing")


def test_plant_of_a_file_under_a_contract(plant_file, tmp_path):
    asked = ("--plant", plant_file.name, "--max-age", 2, "--quantization-step", 0.001)
    assert ncs("synthesize", *asked, cwd=tmp_path).returncode == 0
    contract = Certificate.load(tmp_path / "certificate.json").contract
    assert (contract.max_age, contract.quantization_step) == (2, 0.001)
    alone = ncs("synthesize", "--plant", plant_file.name, "--quantization-step", 0.001, cwd=tmp_path)
    assert_one_sentence(alone, "give --max-age, too")
    both = ncs("synthesize", "--plant", "p.json", "--env", "ncs_gym/TruckTrailer-v0", cwd=tmp_path)
    assert (both.returncode, "not both" in both.stderr) == (2, True)
    missing = ncs("verify", "certificate.json", "--plant", "nowhere.json", cwd=tmp_path)
    assert_one_sentence(missing, "cannot read the plant in ", "nowhere.json: No such file or directory")
    wrong = ncs("verify", "certificate.json", "--plant", "certificate.json", cwd=tmp_path)
    assert_one_sentence(wrong, "certificate.json is not a plant of format")
