"""What a command that trains uses, prints and records of the settings tuned for its environment."""

import json

from agents import tuned_settings
from agents.agent import Agent
from tests.command import ncs

ENV = "ncs_gym/TruckTrailer-v0"
SMALL = ("--steps", 64, "--episodes", 2, "--ppo.envs", 2, "--ppo.rollout", 16)


def test_command_trains_with_tuned_settings_and_records_all_of_them(tmp_path, without_workers):
    run = ncs("train", "--env", ENV, *SMALL, "--ppo.width", 8, "--out", tmp_path / "r")
    assert run.returncode == 0, run.stderr
    assert f"PPO, settings tuned for {ENV}, as given envs, rollout, width:" in run.stdout
    settings = json.loads((tmp_path / "r" / "settings.json").read_text())["settings"]
    agent = Agent.load(tmp_path / "r" / "models" / "shielded-0")
    tuned = vars(tuned_settings(ENV))
    assert settings["ppo"] == vars(agent.settings) == tuned | {"envs": 2, "rollout": 16, "width": 8}
    assert settings["steps"] == 64
    again = ncs("train", "--config", tmp_path / "r" / "settings.json", "--out", tmp_path / "again")
    assert again.returncode == 0, again.stderr
    assert "PPO, settings as given:" in again.stdout
    assert Agent.load(tmp_path / "again" / "models" / "shielded-0").checksum == agent.checksum
