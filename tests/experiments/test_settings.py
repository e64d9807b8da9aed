"""Settings of commands that train: where runs are executed, NAME=VALUE, and hyperparameters given, tuned or default."""

import sys
from dataclasses import replace

import pytest

from agents import tuned_hyperparams, tuned_steps
from agents.hyperparams import DEFAULTS
from experiments.__main__ import parse
from experiments.commands.compare import CompareSettings
from experiments.commands.sweep import SweepSettings
from experiments.commands.train import TrainSettings
from experiments.runs.loops import loop_config
from experiments.runs.training_run import TrainingRun, require_trainable
from experiments.settings import BackendSettings, lasting_settings
from tests.command import assert_one_sentence, ncs

CART_POLE = "ncs_gym/CartPole-v0"


@pytest.mark.parametrize("kind", [CompareSettings, TrainSettings, SweepSettings])
@pytest.mark.parametrize("env_id", [CART_POLE, "ncs_gym/TruckTrailerCruise-v0", "ncs_gym:ncs_gym/BatchReactor-v0"])
def test_hyperparameters_tuned_for_the_environment_are_used(kind, env_id):
    settings, own_id = kind(env=env_id), env_id.rpartition(":")[2]
    assert settings.all_hyperparams == tuned_hyperparams(own_id)
    assert f"PPO, hyperparameters tuned for {own_id}: n_envs=" in settings.agent_line


def test_steps_are_those_given_or_tuned_or_the_default():
    assert tuned_steps(CART_POLE) == CompareSettings(env=CART_POLE).training_steps == 600_000
    assert CompareSettings(env=CART_POLE, steps=150_000).training_steps == 150_000
    assert CompareSettings(env="plants:Plants/Tanks-v0").training_steps == 150_000
    assert CompareSettings(env=CART_POLE, algorithms=("A2C",)).training_steps == 150_000
    assert SweepSettings(env=CART_POLE).training_steps == 50_000
    assert CompareSettings(env=CART_POLE).completed.steps == 600_000


def test_what_is_given_wins_over_the_tuned_values():
    given = ["gamma=0.9", "n_steps=8", 'policy_kwargs={"net_arch": [8]}']
    settings = parse(["train", "--env", CART_POLE, "--steps", "5000", "--hyperparams", *given])
    tuned = tuned_hyperparams(CART_POLE)
    networks = tuned["policy_kwargs"] | {"net_arch": [8]}
    expected = tuned | {"gamma": DEFAULTS["PPO"]["gamma"], "n_steps": 8, "policy_kwargs": networks}
    assert tuned["gamma"] != DEFAULTS["PPO"]["gamma"] == 0.9
    assert settings.all_hyperparams == expected
    assert settings.training_steps == 5000
    assert "as given gamma, policy_kwargs, n_steps: " in settings.agent_line
    assert settings.completed == replace(settings, steps=5000, hyperparams=expected)


@pytest.mark.parametrize("algo", DEFAULTS)
def test_what_cannot_be_trained_with_is_refused_before_anything_is_computed(algo):
    loop = loop_config("ncs_gym/TruckTrailer-v0")
    require_trainable(TrainSettings(algorithms=(algo,), hyperparams={"gamma": 0.8}), loop)
    for change, words in (({"gamma": 2.0}, "gamma must be in"), ({"discount": 0.8}, "unknown hyperparameter")):
        with pytest.raises(ValueError, match=words):
            require_trainable(TrainSettings(algorithms=(algo,), hyperparams=change), loop)


@pytest.mark.parametrize("command", ["compare", "sweep"])
def test_ray_missing_is_one_sentence_that_says_what_to_install(command, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    run = ncs(command, "--engine", "ray", "--out", tmp_path / "out")
    assert_one_sentence(run, "this command needs ray: ", "pip install -e '.[ray]'")
    assert not (tmp_path / "out").exists()


def test_results_of_every_engine_have_the_same_key_and_provenance():
    # A unit does not know its engine, and a summary leaves it out: a sweep begun with one can be finished with another.
    names = set(BackendSettings.__dataclass_fields__)
    assert names
    assert not names & set(TrainingRun.__dataclass_fields__)
    assert not names & lasting_settings(CompareSettings()).keys()


@pytest.mark.parametrize(
    ("text", "value"),
    [("0.5", 0.5), ("null", None), ('{"pi": [64]}', {"pi": [64]}), ("lin_0.1", "lin_0.1")],
)
def test_value_is_a_json_value_or_a_word(text, value):
    assert parse(["compare", "--channel", f"loss={text}"]).channel == {"loss": value}
