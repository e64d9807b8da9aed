"""Prose of the commands follows the terminal."""

import pytest

from experiments.terminal import wrapped

SENTENCE = "The sentence of a well-known length goes on and on. " * 8


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
