"""Warnings of a command are sentences, each printed once on a line of its own."""

import re
import sys
import warnings

from tqdm import tqdm

from experiments.terminal import warnings_as_sentences


def lines_of(text):
    """The lines that stand on a terminal at some time: a carriage return begins a line anew."""
    return [line for line in re.split(r"[\r\n]", text) if line.strip()]


def test_progress_bar_is_cleared_before_a_sentence(capsys):
    with warnings_as_sentences(), tqdm(total=4, file=sys.stderr) as bar:
        bar.update()
        for text in ("one\n  sentence", "one sentence", "another"):
            warnings.warn(text, stacklevel=1)
    said = [line for line in lines_of(capsys.readouterr().err) if "warning" in line]
    assert said == ["ncs: warning: one sentence", "ncs: warning: another"]
