"""What commands show: help, overview, prose, tables, and messages beside a progress bar."""

from __future__ import annotations

import io
import warnings

import pytest

from experiments.__main__ import COMMANDS
from experiments.terminal import progress_bar, say, warnings_as_sentences
from tests.command import ncs

WIDTH = 80


def test_overview_names_every_command_and_is_a_mistake_where_it_was_not_asked_for():
    asked, unasked = ncs("--help"), ncs()
    assert (asked.returncode, unasked.returncode) == (0, 2)
    assert unasked.stdout == asked.stdout
    assert set(COMMANDS) <= set(asked.stdout.split())


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
