"""Whatever a command shows fits into a terminal of 80 columns."""

from __future__ import annotations

import io
import re

import pytest

from experiments.__main__ import COMMANDS, settings_of
from experiments.terminal import progress_bar, say, text_table, warnings_as_sentences
from tests.command import ncs, succeeded

WIDTH = 80
CRUISE = "ncs_gym/TruckTrailerCruise-v0"


def printed(*arguments):
    """What a command prints, without the lines that name its files."""
    done = succeeded(*arguments, COLUMNS=str(WIDTH))
    return "\n".join(
        line for line in done.stdout.splitlines() if not line.startswith(("files: ", "agent: ", "saved to "))
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_help_fits_into_80_columns_and_every_command_has_a_place_for_its_files(command):
    usage, *lines = printed(command, "--help").splitlines()
    assert usage.startswith("usage: ")  # tyro's own, which may be longer
    assert [line for line in lines if len(line) > WIDTH] == []
    assert any("--out" in line for line in lines)
    assert not re.search(r"docs/|\.md\b", " ".join(lines))  # files that a wheel does not have


@pytest.mark.parametrize(("arguments", "code"), [(["--help"], 0), ([], 2)])
def test_overview_has_a_sentence_for_every_command_in_80_columns(arguments, code):
    run = ncs(*arguments, COLUMNS=str(WIDTH))
    assert run.returncode == code
    lines = run.stdout.splitlines()
    assert [line for line in lines if len(line) > WIDTH] == []
    assert len(lines) < 40
    text = " ".join(run.stdout.split())
    for command in COMMANDS:
        does = " ".join(settings_of(command).__doc__.partition("\n\n")[0].split())
        assert f" {command} {does}" in text


def test_columns_of_a_wide_table_stand_closer_together():
    rows = [["name", *(f"column {i}" for i in range(8))], ["title"], ["a", *map(str, range(8))]]
    header, _, title, cells = text_table(rows).splitlines()
    assert len(header) <= WIDTH
    assert (title, cells.split()) == ("title", rows[2])


class Terminal(io.StringIO):
    """A terminal that takes what is written to it."""

    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_messages_share_no_line_with_a_progress_bar(stream, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    monkeypatch.setattr("sys.stderr", errors := stream())
    with warnings_as_sentences(), progress_bar(1000, "training and evaluation") as bar:
        bar.update(500)
        say(f"shielded-0: {'many words of an outcome ' * 8}")
        bar.update(500)
    seen = [line.rpartition("\r")[2].rstrip() for line in errors.getvalue().splitlines()]
    message = [line for line in seen if "words" in line]
    assert not any("%" in line for line in message)
    assert message[0].startswith("shielded-0: many")
    assert len(message) == (3 if stream is Terminal else 1)  # in a file a message is a line
    assert "100%" in seen[-1]
    assert "\r" not in errors.getvalue() or stream is Terminal
