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


def test_help_shows_a_whole_number(capsys):
    for command, metavar in {"train": "{None}|INT", "render": "INT"}.items():
        with pytest.raises(SystemExit):
            _parse([command, "--help"])
        assert re.search(rf"--steps {re.escape(metavar)} ", capsys.readouterr().out)
