import json
from dataclasses import replace

import pytest

from experiments.__main__ import parse
from experiments.errors import SettingsError
from experiments.settings import CompareSettings, SweepSettings, config_defaults, save_settings


@pytest.mark.parametrize(
    ("command", "settings"),
    [
        ("compare", CompareSettings()),
        (
            "compare",
            CompareSettings(
                arms=("monitor", "shielded:switch+penalty"),
                steps=7,
                violation_penalty=0.1 + 0.2,
                algo="SAC",
                smoke=True,
                channel={"loss": 1e-3, "delay": 4},
                hyperparams=dict(learning_rate="lin_1e-05", policy_kwargs=dict(log_std_init=-1.5)),
            ),
        ),
        ("sweep", SweepSettings(losses=(0.0, 1 / 3), quantization_steps=(0.05,))),
        ("sweep", SweepSettings()),
        ("sweep", SweepSettings(jobs=5)),
    ],
)
def test_settings_come_back_exactly(command, settings, tmp_path):
    save_settings(tmp_path / "s.json", command, settings)
    assert parse([command, "--config", str(tmp_path / "s.json")]) == settings


def test_flags_of_the_user_win(tmp_path):
    save_settings(tmp_path / "s.json", "compare", CompareSettings(steps=7, arms=("monitor",), smoke=True))
    own = ["compare", "--steps", "9", f"--config={tmp_path / 's.json'}", "--arms", "shielded", "--no-smoke"]
    read = parse(own)
    assert (read.steps, read.arms, read.smoke) == (9, ("shielded",), False)


def test_assignments_of_the_user_stand_beside_those_of_the_file(tmp_path):
    kept = CompareSettings(hyperparams={"gamma": 0.9, "policy_kwargs": {"net_arch": [8]}}, channel={"delay": 2})
    save_settings(tmp_path / "s.json", "compare", kept)
    given = ["--hyperparams", 'policy_kwargs={"log_std_init": -1.0}', "--channel", "loss=0.5"]
    read = parse(["compare", "--config", str(tmp_path / "s.json"), *given])
    networks = {"net_arch": [8], "log_std_init": -1.0}
    assert read == replace(kept, hyperparams={"gamma": 0.9, "policy_kwargs": networks}, channel=dict(delay=2, loss=0.5))


def test_hyperparameters_of_the_file_give_way_to_another_algorithm(tmp_path):
    save_settings(tmp_path / "s.json", "compare", CompareSettings(hyperparams={"n_epochs": 3}))
    config = ["compare", "--config", str(tmp_path / "s.json"), "--algo", "SAC"]
    assert parse(config).hyperparams == {}
    assert parse([*config, "--hyperparams", "gamma=0.8"]).hyperparams == {"gamma": 0.8}


def test_without_config_nothing_changes():
    for arguments in ([], ["--help"], ["--steps", "9"]):
        assert config_defaults(arguments, "compare", CompareSettings) == (None, arguments)
    assert parse(["compare", "--steps", "9"]) == CompareSettings(steps=9)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot read settings"),
        ("{", "not valid JSON"),
        ("[]", "not of format"),
        (json.dumps({"format": "ncs-gym settings 1", "command": "sweep", "settings": {}}), "of ncs sweep, not of ncs"),
        (json.dumps({"format": "ncs-gym settings 1", "command": "compare", "settings": 3}), "not of ncs compare"),
    ],
)
def test_damaged_and_foreign_files_are_one_sentence(content, words, tmp_path):
    if content is not None:
        (tmp_path / "s.json").write_text(content)
    with pytest.raises(SettingsError, match=words) as caught:
        parse(["compare", "--config", str(tmp_path / "s.json")])
    assert "\n" not in str(caught.value)


def test_config_is_given_once_and_with_a_file(tmp_path):
    save_settings(tmp_path / "s.json", "compare", CompareSettings())
    twice = ["compare", "--config", str(tmp_path / "s.json"), "--config", "other.json"]
    for arguments, words in ((twice, "2 times"), (["compare", "--config"], "needs a file")):
        with pytest.raises(SettingsError, match=words):
            parse(arguments)


@pytest.mark.parametrize("values", [{"arms": ["shielded", "--seed", "9"]}, {"env": "--help"}])
def test_values_in_a_file_are_no_flags(values, tmp_path):
    path = written(tmp_path, values)
    name, value = next(iter(values.items()))
    read = parse(["compare", "--config", path])
    assert read == replace(CompareSettings(), **{name: tuple(value) if isinstance(value, list) else value})


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"-x": 1}, "-x = 1"),
        ({"config": "other.json"}, "config = "),
        ({"seed": True}, "seed = true"),
        ({"seed": 7.0}, "seed = 7.0"),
        ({"steps": "7"}, 'steps = "7"'),
        ({"smoke": 1}, "smoke = 1"),
        ({"env": 5}, "env = 5"),
        ({"arms": "shielded"}, 'arms = "shielded"'),
        ({"steps": 10**400, "violation_penalty": 10**400}, "violation_penalty = 1000"),
        ({"ppo": 3}, "ppo = 3"),
        ({"hyperparams": 3}, "hyperparams = 3"),
        ({"channel": {"loss": float("nan")}}, "channel.loss = NaN"),
        ({"hyperparams": {"gamma": float("inf")}}, "hyperparams.gamma = Infinity"),
        ({"steps": 0}, "--steps must be at least 1"),
    ],
)
def test_wrong_values_in_a_file_are_named(values, words, tmp_path):
    with pytest.raises(SettingsError, match=r"hold what ncs compare does not take: ") as caught:
        parse(["compare", "--config", written(tmp_path, values)])
    assert words in str(caught.value)


def written(folder, values):
    document = {"format": "ncs-gym settings 1", "command": "compare", "settings": values}
    (folder / "s.json").write_text(json.dumps(document))
    return str(folder / "s.json")
