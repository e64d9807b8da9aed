import json
from dataclasses import asdict, fields
from pathlib import Path

import pytest

from agents import tuned_settings, tuned_steps
from agents.settings import PPOSettings
from agents.tuned.entries import _entries
from ncs_gym.registration import ENVIRONMENTS, needing_extras, registered_ids

FILE = Path(__file__).resolve().parents[2] / "agents" / "tuned" / "ppo.json"
OWN = [env_id for env_id in ENVIRONMENTS if env_id in {*registered_ids(), *needing_extras()}]


@pytest.mark.parametrize("env_id", OWN)
def test_registered_environment_has_tuned_settings(env_id):
    entry = json.loads(FILE.read_text())[env_id]
    assert set(entry) == {"steps"} | {field.name for field in fields(PPOSettings)}
    settings = tuned_settings(env_id)
    assert isinstance(settings, PPOSettings)
    assert {"steps": tuned_steps(env_id)} | asdict(settings) == entry
    assert entry["steps"] >= 100_000


def test_file_names_registered_environments_only():
    assert set(_entries("PPO")) == set(OWN)
    assert len(OWN) == 9


@pytest.mark.parametrize("env_id", ["ncs_gym/LinearNCS-v0", "Plants/Tanks-v0", "ncs_gym:ncs_gym/CartPole-v0"])
def test_plant_of_ones_own_has_none(env_id):
    assert tuned_settings(env_id) is None
    assert tuned_steps(env_id) is None


@pytest.mark.parametrize("algorithm", ["TRPO", "A2C", "SAC", "TD3", "../ppo"])
def test_algorithm_that_was_not_tuned_has_none(algorithm):
    assert tuned_settings("ncs_gym/CartPole-v0", algorithm) is None
    assert tuned_steps("ncs_gym/CartPole-v0", algorithm) is None


def test_settings_of_environments_differ():
    found = {tuned_settings(env_id) for env_id in OWN}
    assert len(found) > 1
    assert found != {PPOSettings()}


def test_budget_of_the_main_job_has_not_grown():
    assert tuned_steps("ncs_gym/TruckTrailerCruise-v0") == 150_000


def test_discount_of_the_cart_pole_sees_farther_than_a_fifth_of_a_second():
    settings = tuned_settings("ncs_gym/CartPole-v0")
    assert isinstance(settings, PPOSettings)
    assert 0.02 / (1.0 - settings.discount) > 0.5
