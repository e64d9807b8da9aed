"""Commands for a user's own plant: `--env module:id` and `--plant FILE`."""

import json
import sys

import gymnasium as gym
import pytest

from ncs_gym import truck_trailer
from shields import Certificate
from tests.command import assert_one_sentence, ncs, succeeded, without_pictures
from tests.verdicts import verified

MODULE = """
from ncs_gym import Channel, register_plant, truck_trailer

register_plant("Plants/Truck-v0", truck_trailer(mass=2000.0), channel=Channel(loss=0.2), max_episode_steps=20)
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
    (tmp_path / "own_task.py").write_text(TASK)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for module, env_id in {"own_plants": "Plants/Truck-v0", "own_task": "Plants/Far-v0"}.items():
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
