from dataclasses import asdict, fields, replace

import pytest
from agents.settings import A2CSettings, OffPolicySettings, PPOSettings
from experiments.settings.agent_overrides import A2COverrides, OffPolicyOverrides, PPOOverrides

from agents import tuned_settings, tuned_steps
from experiments.__main__ import _parse
from experiments.settings import CompareSettings, SweepSettings, TrainSettings, save_settings

CART_POLE = "ncs_gym/CartPole-v0"


@pytest.mark.parametrize(
    ("overrides", "settings"),
    [(PPOOverrides, PPOSettings), (A2COverrides, A2CSettings), (OffPolicyOverrides, OffPolicySettings)],
)
def test_every_setting_can_be_given_and_none_is_by_default(overrides, settings):
    assert {field.name for field in fields(overrides)} == {field.name for field in fields(settings)}
    assert set(asdict(overrides()).values()) == {None}


@pytest.mark.parametrize("kind", [CompareSettings, TrainSettings, SweepSettings])
@pytest.mark.parametrize("env_id", [CART_POLE, "ncs_gym/TruckTrailerCruise-v0", "ncs_gym:ncs_gym/BatchReactor-v0"])
def test_settings_tuned_for_the_environment_are_used(kind, env_id):
    settings = kind(env=env_id)
    assert settings.agent == tuned_settings(env_id.rpartition(":")[2])
    assert f"tuned for {env_id.rpartition(':')[2]}:" in settings.agent_line


@pytest.mark.parametrize(
    ("algo", "plain"), [("PPO", PPOSettings()), ("A2C", A2CSettings()), ("SAC", OffPolicySettings())]
)
def test_plant_of_ones_own_gets_the_defaults(algo, plain):
    settings = CompareSettings(env="plants:Plants/Tanks-v0", algo=algo)
    assert settings.agent == plain
    assert "default settings:" in settings.agent_line


@pytest.mark.parametrize("algo", ["TRPO", "A2C", "TD3"])
def test_algorithm_that_was_not_tuned_gets_the_defaults(algo):
    settings = CompareSettings(env=CART_POLE, algo=algo)
    assert settings.agent == type(settings.agent)()
    assert f"{algo}, default settings:" in settings.agent_line


def test_steps_are_those_given_or_tuned_or_the_default():
    assert tuned_steps(CART_POLE) == CompareSettings(env=CART_POLE).training_steps == 600_000
    assert CompareSettings(env=CART_POLE, steps=150_000).training_steps == 150_000
    assert CompareSettings(env="plants:Plants/Tanks-v0").training_steps == 150_000
    assert CompareSettings(env=CART_POLE, algo="A2C").training_steps == 150_000
    assert SweepSettings(env=CART_POLE).training_steps == 50_000
    assert CompareSettings(env=CART_POLE).completed.steps == 600_000


def test_option_wins_over_the_tuned_value_also_if_it_equals_the_default():
    default = PPOSettings().discount
    tuned = tuned_settings(CART_POLE)
    assert isinstance(tuned, PPOSettings)
    assert tuned.discount != default
    settings = _parse(["compare", "--env", CART_POLE, "--ppo.discount", str(default)])
    assert isinstance(settings, CompareSettings)
    assert settings.agent == replace(tuned, discount=default)
    assert "as given discount:" in settings.agent_line


def test_completed_settings_come_back_whatever_is_tuned_later(tmp_path, monkeypatch):
    completed = CompareSettings(env=CART_POLE, ppo=PPOOverrides(width=16)).completed
    assert None not in asdict(completed.ppo).values()
    save_settings(tmp_path / "s.json", "compare", completed)
    agent = completed.agent
    later = PPOSettings(width=7, epochs=1)
    monkeypatch.setattr("experiments.settings.agent_overrides.tuned_settings", lambda *_: later)
    read = _parse(["compare", "--config", str(tmp_path / "s.json")])
    assert read == completed
    assert isinstance(read, CompareSettings)
    assert read.agent == agent
    assert "settings as given:" in read.agent_line


def test_file_that_gives_an_environment_alone_gets_its_tuned_settings(tmp_path):
    save_settings(tmp_path / "s.json", "compare", CompareSettings(env=CART_POLE))
    read = _parse(["compare", "--config", str(tmp_path / "s.json")])
    assert isinstance(read, CompareSettings)
    assert read.agent == tuned_settings(CART_POLE)


@pytest.mark.parametrize(
    ("overrides", "change"),
    [
        (PPOOverrides, {"discount": 2.0}),
        (PPOOverrides, {"entropy": -1.0}),
        (PPOOverrides, {"normalize_rewards": 1}),
        (A2COverrides, {"envs": 0}),
        (OffPolicyOverrides, {"noise": -0.1}),
    ],
)
def test_value_out_of_range_is_refused_by_name(overrides, change):
    with pytest.raises(ValueError, match=next(iter(change))):
        overrides(**change)


def test_values_that_do_not_fit_together_are_refused():
    with pytest.raises(ValueError, match="at least 2"):
        CompareSettings(ppo=PPOOverrides(rollout=1, envs=1)).agent  # noqa: B018
