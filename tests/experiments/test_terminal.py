"""What commands show: help, overview, prose, tables, and messages beside a progress bar."""

from __future__ import annotations

import io
import re
import warnings

import pytest

from experiments.__main__ import COMMANDS, settings_of
from experiments.terminal import progress_bar, say, text_table, warnings_as_sentences, wrapped
from tests.command import ncs, succeeded

WIDTH = 80
SENTENCE = "The sentence of a well-known length goes on and on. " * 8


@pytest.mark.parametrize("command", COMMANDS)
def test_help_fits_into_80_columns_and_every_command_has_a_place_for_its_files(command):
    usage, *lines = succeeded(command, "--help", COLUMNS=str(WIDTH)).stdout.splitlines()
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
def test_messages_share_no_line_with_a_progress_bar_and_warnings_are_said_once(stream, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    monkeypatch.setattr("sys.stderr", errors := stream())
    with warnings_as_sentences(), progress_bar(1000, "training and evaluation") as bar:
        bar.update(500)
        say(f"shielded-0: {'many words of an outcome ' * 8}")
        for text in ("one\n  sentence", "one sentence", "another"):
            warnings.warn(text, stacklevel=1)
        bar.update(500)
    seen = [line.rpartition("\r")[2].rstrip() for line in errors.getvalue().splitlines()]
    message = [line for line in seen if "words" in line]
    assert not any("%" in line for line in message)
    assert message[0].startswith("shielded-0: many")
    assert len(message) == (3 if stream is Terminal else 1)  # in a file a message is a line
    said = [line for line in seen if "warning" in line]
    assert said == ["ncs: warning: one sentence", "ncs: warning: another"]
    assert "100%" in seen[-1]
    assert "\r" not in errors.getvalue() or stream is Terminal


@pytest.mark.parametrize(("columns", "width"), [("70", 70), ("300", 80), ("20", 60)])
def test_text_follows_the_terminal_between_60_and_80_columns(monkeypatch, columns, width):
    monkeypatch.setenv("COLUMNS", columns)
    first, *rest = wrapped(SENTENCE).splitlines()
    assert width - 12 < max(map(len, [first, *rest])) <= width
    assert not first.startswith(" ")
    assert all(line.startswith("  ") for line in rest)
    assert " ".join([first, *rest]).split() == SENTENCE.split()


def test_long_words_and_hyphens_are_not_broken(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    path = "/".join(["folder-with-hyphens"] * 8)
    assert path in wrapped(f"the files are in {path} for now").splitlines()[1]
