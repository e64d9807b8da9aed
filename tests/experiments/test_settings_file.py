import json

import pytest
import tyro

from agents.settings import PPOSettings
from experiments.errors import SettingsError
from experiments.settings.channel import ChannelSettings
from experiments.settings.learning import CompareSettings, SweepSettings
from experiments.settings.settings_file import save_settings, with_config


def parsed(kind, arguments):
    return tyro.cli(kind, args=arguments)


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
                channel=ChannelSettings(loss=1e-3, delay=4),
                ppo=PPOSettings(learning_rate=1e-5, log_std=-1.5),
            ),
        ),
        ("sweep", SweepSettings(losses=(0.0, 1 / 3), quantization_steps=(0.05,))),
        ("sweep", SweepSettings()),
        (
            "sweep",
            SweepSettings(engine="ray", ray_address="head:6379", cpus_per_run=0.5, gpus_per_run=2.0, ray_wait=60.0),
        ),
    ],
)
def test_settings_come_back_exactly(command, settings, tmp_path):
    save_settings(tmp_path / "s.json", command, settings)
    flags = with_config([command, "--config", str(tmp_path / "s.json")])
    assert flags[0] == command
    assert parsed(type(settings), flags[1:]) == settings


def test_flags_of_the_user_win(tmp_path):
    save_settings(tmp_path / "s.json", "compare", CompareSettings(steps=7, arms=("monitor",), smoke=True))
    own = ["compare", "--steps", "9", f"--config={tmp_path / 's.json'}", "--arms", "shielded", "--no-smoke"]
    read = parsed(CompareSettings, with_config(own)[1:])
    assert (read.steps, read.arms, read.smoke) == (9, ("shielded",), False)


def test_without_config_nothing_changes():
    for arguments in ([], ["--help"], ["compare", "--steps", "9"]):
        assert with_config(arguments) == arguments


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
        with_config(["compare", "--config", str(tmp_path / "s.json")])
    assert "\n" not in str(caught.value)


def test_config_is_given_once_and_with_a_file(tmp_path):
    save_settings(tmp_path / "s.json", "compare", CompareSettings())
    twice = ["compare", "--config", str(tmp_path / "s.json"), "--config", "other.json"]
    for arguments, words in ((twice, "2 times"), (["compare", "--config"], "needs a file")):
        with pytest.raises(SettingsError, match=words):
            with_config(arguments)


@pytest.mark.parametrize("values", [{"arms": ["shielded", "--seed", "9"]}, {"env": "--help"}, {"-x": 1}])
def test_values_in_a_file_are_no_flags(values, tmp_path):
    document = {"format": "ncs-gym settings 1", "command": "compare", "settings": values}
    (tmp_path / "s.json").write_text(json.dumps(document))
    with pytest.raises(SettingsError, match="a value that is none"):
        with_config(["compare", "--config", str(tmp_path / "s.json")])
