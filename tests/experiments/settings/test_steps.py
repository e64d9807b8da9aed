"""Numbers of steps on the command line."""

import re

import pytest

from experiments.__main__ import _parse

COMMANDS = ("compare", "train", "sweep", "render", "reproduce")


@pytest.mark.parametrize("command", COMMANDS)
def test_steps_are_also_written_as_a_power_of_ten(command):
    for text, number in {
        "1e5": 100_000,
        "2.5e3": 2_500,
        "12.0": 12,
        "100000": 100_000,
        "9007199254740.0": 9007199254740,
    }.items():
        steps = _parse([command, "--steps", text]).steps
        assert (type(steps), steps) == (int, number)


@pytest.mark.parametrize("command", ["compare", "train"])
def test_no_steps_are_those_tuned_for_the_environment(command):
    assert _parse([command]).steps is None
    assert _parse([command, "--steps", "None"]).steps is None


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    "text",
    [
        "1.5",
        "1e-3",
        "1e400",
        "1e999999999",
        "1e-999999999",
        "1e99999999999999999999",
        "4503599627370496.2",
        "nan",
        "inf",
        "many",
        "",
    ],
)
def test_what_is_no_whole_number_of_steps_is_refused_in_one_sentence(command, text, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as end:
        _parse([command, "--steps", text])
    assert end.value.code == 2
    shown = capsys.readouterr().err
    assert f"--steps: expected a whole number below 1e15, such as 100000 or 1e5, got {text!r}" in shown
    assert "no type matching" not in shown


def test_help_shows_a_whole_number(capsys):
    for command, metavar in {"train": "{None}|INT", "render": "INT"}.items():
        with pytest.raises(SystemExit):
            _parse([command, "--help"])
        assert re.search(rf"--steps {re.escape(metavar)} ", capsys.readouterr().out)
