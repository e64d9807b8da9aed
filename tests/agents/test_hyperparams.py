"""Hyperparameters: those tuned for each environment, and those of a file."""

import json
from pathlib import Path

import pytest

import agents
from agents import read_hyperparams, tuned_hyperparams, tuned_steps
from agents.hyperparams import DEFAULTS, complete_hyperparams, literal, with_changes
from ncs_gym.registration import ENVIRONMENTS, needing_extras, registered_ids

# Those of the three have the defaults: none were sought.
DEFAULT = {
    f"ncs_gym/{name}-v0" for name in ("CSTR", "Convoy", "ConvoyOnRequest", "LaneKeeping", "LaneKeepingOnRequest")
}
OWN = [env_id for env_id in ENVIRONMENTS if env_id in {*registered_ids(), *needing_extras()} - DEFAULT]


@pytest.mark.parametrize("env_id", OWN)
def test_registered_environment_has_tuned_hyperparameters(env_id):
    tuned = tuned_hyperparams(env_id)
    assert tuned is not None
    assert tuned.keys() == DEFAULTS["PPO"].keys()
    assert tuned_steps(env_id) >= 100_000


def test_file_names_registered_environments_only():
    assert set(json.loads((Path(agents.__file__).parent / "tuned" / "ppo.json").read_text())) == set(OWN)
    assert len(OWN) == 9


@pytest.mark.parametrize(
    "given",
    [
        *((env_id,) for env_id in ("ncs_gym/LinearNCS-v0", "Plants/Tanks-v0", "ncs_gym:ncs_gym/CartPole-v0")),
        *(("ncs_gym/CartPole-v0", algorithm) for algorithm in ("TRPO", "A2C", "SAC", "TD3", "../ppo")),
    ],
)
def test_plant_of_ones_own_and_algorithm_that_was_not_tuned_have_none(given):
    assert tuned_hyperparams(*given) is None
    assert tuned_steps(*given) is None


def test_budget_of_the_main_job_has_not_grown():
    assert tuned_steps("ncs_gym/TruckTrailerCruise-v0") == 150_000


def test_discount_of_the_cart_pole_sees_farther_than_a_fifth_of_a_second():
    assert 0.02 / (1.0 - tuned_hyperparams("ncs_gym/CartPole-v0")["gamma"]) > 0.5


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("mine.yml", "A-v0:\n  n_envs: 8\n  n_timesteps: !!float 1e5\n  policy_kwargs: dict(net_arch=[64, 64])\n"),
        ("mine.json", '{"A-v0": {"n_envs": 8, "n_timesteps": 1e5, "policy_kwargs": {"net_arch": [64, 64]}}}'),
    ],
)
def test_file_like_those_of_rl_zoo3_is_read(name, text, tmp_path):
    (tmp_path / name).write_text(text)
    found = read_hyperparams(tmp_path / name, "A-v0")
    assert found == {"n_envs": 8, "n_timesteps": 100_000, "policy_kwargs": {"net_arch": [64, 64]}}
    with pytest.raises(ValueError, match="has no hyperparameters for B-v0, nor for default"):
        read_hyperparams(tmp_path / name, "B-v0")


@pytest.mark.parametrize(("name", "text"), [("m.json", "{"), ("m.yml", "{"), ("m.yml", "!!python/name:os.system")])
def test_damaged_file_is_one_sentence_and_runs_nothing(name, text, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match="are damaged: ") as caught:
        read_hyperparams(tmp_path / name, "A-v0")
    assert "\n" not in str(caught.value)


def test_text_that_calls_something_stays_a_text():
    for text in ("dict(a=print(1))", "exec('1')", "dict([1])", "lin_0.1", "{1, 2}", "1e999"):
        assert literal(text) == text


def test_part_of_the_networks_arguments_may_be_changed():
    changed = with_changes(DEFAULTS["PPO"], {"gamma": 0.99, "policy_kwargs": {"net_arch": [8]}})
    expected = {"gamma": 0.99, "policy_kwargs": {"net_arch": [8], "log_std_init": -0.7}}
    assert changed == DEFAULTS["PPO"] | expected
    assert complete_hyperparams("PPO", expected) == changed
    assert DEFAULTS["PPO"]["policy_kwargs"]["net_arch"] == [64, 64]
