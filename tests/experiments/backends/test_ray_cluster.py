"""What does not need Ray of executing training runs on Ray."""

import pickle
import socket
import sys
import time
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest

from agents.loop import LoopConfig
from experiments.backends import ray_cluster
from experiments.backends.execution import results_of
from experiments.backends.ray_cluster import _execute_on_node, execute_submitted, portable_task, require_answer
from experiments.errors import ClusterError, RunError
from experiments.runs import TrainingRun, execute_run, versions
from experiments.settings import BackendSettings


@pytest.fixture(scope="module")
def run(certificate):
    loop = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0")
    return TrainingRun(
        arm="unshielded",
        policy_kind="zero input",
        training_loop=loop,
        loop=loop,
        seed=0,
        index=0,
        steps=64,
        episodes=1,
        certificate=certificate,
        algorithm="PPO",
        settings={},
    )


class FakeCluster:
    """A cluster that executes two runs at a time, later ones first."""

    def __init__(self, failures=None):
        self.pending, self.cancelled, self.kept, self.read = [], [], [], 0
        self.most, self.read_at_waits, self.failures = 0, [], failures or {}

    def runs(self, count):
        for number in range(count):
            self.read += 1
            yield SimpleNamespace(name=str(number))

    def submit(self, run):
        self.pending.append(run.name)
        self.most = max(self.most, len(self.pending))
        return run.name

    def wait(self, references):
        assert references == self.pending
        self.read_at_waits.append(self.read)
        done = self.pending[-2:]
        del self.pending[-2:]
        return done

    def result(self, run, reference):
        assert run.name == reference
        if reference in self.failures:
            raise self.failures[reference]
        return int(reference)

    def keep(self, run, result):
        self.kept.append(result)

    def execute(self, count):
        execute_submitted(self.runs(count), self.submit, self.wait, self.result, self.cancelled.extend, self.keep)


@pytest.mark.parametrize(("count", "limit"), [(0, 4), (1, 4), (7, 1), (25, 4), (25, 100)])
def test_every_run_is_collected_once_and_no_more_are_submitted_than_the_limit(count, limit, monkeypatch):
    monkeypatch.setattr(ray_cluster, "MAX_SUBMITTED", limit)
    fake = FakeCluster()
    fake.execute(count)
    assert sorted(fake.kept) == list(range(count))
    assert fake.most == min(count, limit)
    assert fake.cancelled == []


def test_runs_are_read_only_as_far_as_they_may_be_submitted(monkeypatch):
    monkeypatch.setattr(ray_cluster, "MAX_SUBMITTED", 5)
    fake = FakeCluster()
    fake.execute(9)
    assert fake.read_at_waits[:3] == [5, 7, 9]


@pytest.mark.parametrize("failure", [RunError("run 4"), ClusterError("run 4")])
def test_failure_keeps_what_was_finished_beside_it_and_cancels_the_rest(failure, monkeypatch):
    monkeypatch.setattr(ray_cluster, "MAX_SUBMITTED", 6)
    fake = FakeCluster({"4": failure})
    with pytest.raises(type(failure), match="run 4"):
        fake.execute(9)
    assert fake.kept == [5]  # the fake finishes 4 and 5 at once
    assert fake.cancelled == ["0", "1", "2", "3"]


def test_interruption_cancels_what_is_submitted(monkeypatch):
    def interrupted(run, result):
        raise KeyboardInterrupt

    monkeypatch.setattr(ray_cluster, "MAX_SUBMITTED", 4)
    fake = FakeCluster()
    fake.keep = interrupted
    with pytest.raises(KeyboardInterrupt):
        fake.execute(9)
    assert fake.cancelled == ["0", "1"]


def test_waiting_for_nothing_goes_on_waiting():
    fake, silent = FakeCluster(), [3]
    wait = fake.wait

    def wait_in_vain(references):
        silent[0] -= 1
        return [] if silent[0] >= 0 else wait(references)

    fake.wait = wait_in_vain
    fake.execute(2)
    assert silent == [-1]
    assert sorted(fake.kept) == [0, 1]


def test_worker_returns_what_the_run_returns_here(run):
    result, expected = (
        _execute_on_node(versions(), pickle.dumps(partial(execute_run, run))),
        execute_run(run, lambda steps: None),
    )
    assert result.episodes == expected.episodes
    assert (result.trajectory.states == expected.trajectory.states).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"source": "other"}, "another source of ncs-gym than the driver: install the same on every node"),
        ({"torch": "0.1"}, r"torch .* where the driver has 0\.1"),
        ({"jax": "1.0"}, r"no jax where the driver has 1\.0"),
        ({"source": "other", "torch": "0.1"}, "torch"),  # the more telling one
    ],
)
def test_worker_with_other_versions_refuses_before_it_reads_the_run(change, words):
    with pytest.raises(ClusterError, match=words):
        _execute_on_node(versions() | change, b"no run")


def test_worker_with_a_package_that_the_driver_lacks_refuses():
    expected = versions()
    del expected["torch"]
    with pytest.raises(ClusterError, match="where the driver has none"):
        _execute_on_node(expected, b"no run")


def test_node_without_this_package_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "experiments.backends.ray_cluster", None)
    monkeypatch.delattr("experiments.backends.ray_cluster")
    with pytest.raises(ImportError, match=r"node .* cannot import ncs-gym .*: install the same on every node"):
        portable_task()({}, b"")


def test_address_where_nobody_listens_is_one_sentence_at_once():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    start = time.monotonic()
    with pytest.raises(ClusterError, match=f"nobody answers at --ray-address 127.0.0.1:{port}: .*refused"):
        require_answer(f"127.0.0.1:{port}")
    assert time.monotonic() - start < 5.0


@pytest.mark.parametrize("address", ["no-such-host.invalid:6379", "127.0.0.1:99999", "a" * 70 + ":1", ".:1"])
def test_impossible_address_is_one_sentence(address):
    with pytest.raises(ClusterError, match="nobody answers at --ray-address"):
        require_answer(address)


def test_run_that_fails_locally_is_named_and_the_finished_are_kept(run, tmp_path):
    # Whichever comes first, the good one is finished by then or ends before the workers do.
    bad = replace(run, policy_kind="trained", index=1, algorithm="SAC", settings={"n_steps": 0})
    with pytest.raises(RunError, match=r"run unshielded-1: n_steps must be a whole number >= 1, got 0") as error:
        results_of([run, bad], tmp_path, BackendSettings(jobs=1))
    assert isinstance(error.value.__cause__, ValueError)
    assert [path.stem for path in (tmp_path / "units").glob("*.json")] == ["unshielded-0"]
