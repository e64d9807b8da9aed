"""What a command that trains uses, prints and records of the hyperparameters tuned for its environment."""

import json

from agents import tuned_hyperparams
from agents.agent import Agent
from tests.command import succeeded

ENV = "ncs_gym/TruckTrailer-v0"
SMALL = ("--steps", 64, "--episodes", 2, "--hyperparams", "n_envs=2", "n_steps=16")


def test_command_trains_with_tuned_hyperparameters_and_records_all_of_them(tmp_path, without_workers):
    networks = 'policy_kwargs={"net_arch": [8, 8]}'
    run = succeeded("train", "--env", ENV, *SMALL, networks, "--out", tmp_path / "r")
    prose = run.prose
    assert f"PPO, hyperparameters tuned for {ENV}, as given n_envs, policy_kwargs, n_steps: n_envs=2, " in prose
    settings = json.loads((tmp_path / "r" / "settings.json").read_text())["settings"]
    agent = Agent.load(tmp_path / "r" / "models" / "shielded-0")
    tuned = tuned_hyperparams(ENV)
    expected = tuned | {"n_envs": 2, "n_steps": 16, "policy_kwargs": tuned["policy_kwargs"] | {"net_arch": [8, 8]}}
    assert settings["hyperparams"] == agent.hyperparams == expected
    assert settings["steps"] == 64
    given = [f"{name}={json.dumps(value)}" for name, value in expected.items()]
    again = succeeded("train", "--env", ENV, *SMALL[:4], "--hyperparams", *given, "--out", tmp_path / "again")
    assert "PPO, hyperparameters as given: " in again.stdout
    assert Agent.load(tmp_path / "again" / "models" / "shielded-0").checksum == agent.checksum
