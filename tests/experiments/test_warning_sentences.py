"""Warnings of a command are sentences, each printed once on a line of its own."""

import re
import sys
import warnings

import pytest
from tqdm import tqdm

from experiments.terminal import warnings_as_sentences
from tests.command import ncs

# Samples may become older than the contract allows from a delay of 5 steps on.
SWEEP = ("sweep", "--env", "ncs_gym/CartPole-v0", "--losses", 0, "--delays", 8, 9, "--seeds", 1, "--episodes", 1)
SWEEP += ("--arms", "lqr+shielded", "lqr+lookahead")


def lines_of(text):
    """The lines that stand on a terminal at some time: a carriage return begins a line anew."""
    return [line for line in re.split(r"[\r\n]", text) if line.strip()]


@pytest.mark.slow
def test_warning_of_worker_processes_is_a_sentence_that_is_said_once_for_each_delay(tmp_path):
    run = ncs(*SWEEP, "--jobs", 2, "--out", tmp_path)
    assert run.returncode == 0, run.stderr
    said = [line for line in lines_of(run.stderr) if "is likely to be lost" in line]
    starts = [f"ncs: warning: the channel lets the newest sample become {age} steps old" for age in (8, 9)]
    assert [line.partition(",")[0] for line in sorted(said)] == starts
    assert "Warning" not in run.stderr
    assert ".py" not in run.stderr


def test_progress_bar_is_cleared_before_a_sentence(capsys):
    with warnings_as_sentences(), tqdm(total=4, file=sys.stderr) as bar:
        bar.update()
        for text in ("one\n  sentence", "one sentence", "another"):
            warnings.warn(text, stacklevel=1)
    said = [line for line in lines_of(capsys.readouterr().err) if "warning" in line]
    assert said == ["ncs: warning: one sentence", "ncs: warning: another"]
