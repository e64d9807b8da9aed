"""The same seed gives the same bits: twice in one process, and in another process with other hashes."""

import json
import os
import subprocess
import sys

import pytest

from tests.command import ROOT, environment
from tests.runs import everything, seeded

STEPS = 10


def in_another_process(seed, steps, hashes):
    command = [sys.executable, "-m", "tests.runs", str(seed), str(steps)]
    given = environment(PYTHONHASHSEED=hashes, OPENBLAS_NUM_THREADS=os.environ["OPENBLAS_NUM_THREADS"])
    ended = subprocess.run(command, cwd=ROOT, env=given, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


@pytest.mark.slow
def test_same_seed_gives_the_same_bits_in_every_process():
    first, second, other = everything(3, STEPS), seeded(3, STEPS), seeded(4, STEPS)
    assert {name: first[name] for name in second} == second
    assert in_another_process(3, STEPS, hashes="1") == first
    # What has a seed depends on it.
    assert first.keys() - other.keys() == {"certified", "contract"}
    assert not {name for name in other if first[name] == other[name]}
