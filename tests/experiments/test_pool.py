"""Worker processes: what becomes of the others when one fails."""

import threading
import time
from dataclasses import replace
from queue import Queue

import pytest

from agents.settings import PPOSettings
from experiments.backends.processes import _work, run_all
from experiments.errors import RunStopped
from experiments.runs.training_run import Unit


@pytest.fixture(scope="module")
def endless(certificate):
    """A unit that would run for hours."""
    return Unit(
        arm="zero input",
        learner="zero",
        env="ncs_gym/TruckTrailerCruise-v0",
        seed=0,
        index=0,
        steps=0,
        episodes=10_000_000,
        certificate=certificate,
        mode=None,
        algorithm="PPO",
        settings=PPOSettings(),
    )


def test_a_unit_told_to_stop_gives_up_at_its_next_report(endless):
    news, stop = Queue(), threading.Event()
    stop.set()
    with pytest.raises(RunStopped, match="zero-input-0"):
        _work(endless, None, news, stop)
    assert news.empty()


def test_the_first_failure_stops_the_others_and_is_the_one_reported(endless):
    broken = replace(endless, arm="broken", env="ncs_gym/Nowhere-v0")
    begin, kept = time.monotonic(), []
    with pytest.raises(Exception, match="Nowhere") as caught:
        run_all([endless, broken], 2, 1000, lambda unit, result: kept.append(unit))
    assert not isinstance(caught.value, RunStopped)
    assert kept == []
    assert time.monotonic() - begin < 300.0
