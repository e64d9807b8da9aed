"""What does not need Ray of executing training runs on Ray."""

import pickle
import socket
import sys
import time
from concurrent.futures import Future
from dataclasses import replace

import pytest

from experiments.backends import execution
from experiments.backends.execution import execute, results_of
from experiments.backends.ray_cluster import portable_task, require_answer
from experiments.errors import ClusterError, RunError
from experiments.runs.provenance import versions
from experiments.settings import BackendSettings
from tests.experiments.results import training_run


@pytest.fixture(scope="module")
def run(certificate):
    return training_run(certificate, arm="unshielded")


class FakeExecutor:
    """Executes two runs at a time, later ones first, where the driver looks for reports."""

    def __init__(self, failures=None):
        self.pending, self.left, self.kept, self.most, self.failures = {}, None, [], 0, failures or {}

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.left = sorted(self.pending)

    def submit(self, run):
        future = self.pending[run.index] = Future()
        self.most = max(self.most, len(self.pending))
        return future

    def reports(self):
        for index in sorted(self.pending)[-2:]:
            future = self.pending.pop(index)
            if index in self.failures:
                future.set_exception(ValueError(self.failures[index]))
            else:
                future.set_result(index)
            yield 1

    def failure(self, run, error):
        return RunError(f"run {run.index}: {error}")

    def execute(self, run, count):
        execute([replace(run, index=index) for index in range(count)], self, lambda run, kept: self.kept.append(kept))


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(execution, "_READING_PERIOD", 0.01)


@pytest.mark.parametrize(("count", "limit"), [(0, 4), (1, 4), (7, 1), (25, 4), (25, 100)])
def test_every_run_is_collected_once_and_no_more_are_submitted_than_the_limit(count, limit, run, monkeypatch):
    monkeypatch.setattr(execution, "MAX_SUBMITTED", limit)
    fake = FakeExecutor()
    fake.execute(run, count)
    assert sorted(fake.kept) == list(range(count))
    assert fake.most == min(count, limit)
    assert fake.left == []


def test_failure_keeps_what_was_finished_beside_it_and_stops_the_rest(run, monkeypatch):
    monkeypatch.setattr(execution, "MAX_SUBMITTED", 6)
    fake = FakeExecutor({4: "broken"})
    with pytest.raises(RunError, match="run 4: broken") as error:
        fake.execute(run, 9)
    assert isinstance(error.value.__cause__, ValueError)
    assert fake.kept == [5]  # the fake finishes 4 and 5 at once
    assert fake.left == [0, 1]  # 2 and 3 were finished meanwhile


def test_interruption_leaves_what_is_submitted_to_the_executor(run):
    fake = FakeExecutor()

    class Interrupted(list):
        def append(self, result):
            raise KeyboardInterrupt

    fake.kept = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        fake.execute(run, 9)
    assert fake.left == [0, 1, 2, 3, 4]


def test_worker_returns_what_the_run_returns_here(run):
    result, expected = (portable_task()(versions(), pickle.dumps(run)), run.execute(lambda steps: None))
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
        portable_task()(versions() | change, b"no run")


def test_worker_with_a_package_that_the_driver_lacks_refuses():
    expected = versions()
    del expected["torch"]
    with pytest.raises(ClusterError, match="where the driver has none"):
        portable_task()(expected, b"no run")


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


@pytest.mark.slow
def test_run_that_fails_locally_is_named_and_the_finished_are_kept(run, tmp_path):
    # Whichever comes first, the good one is finished by then or ends before the workers do.
    bad = replace(run, policy_kind="trained", index=1, algorithm="SAC", settings={"n_steps": 0})
    with pytest.raises(RunError, match=r"run unshielded-1: n_steps must be a whole number >= 1, got 0") as error:
        results_of([run, bad], tmp_path, BackendSettings(jobs=1))
    assert isinstance(error.value.__cause__, ValueError)
    assert [path.stem for path in (tmp_path / "runs").glob("*.json")] == ["unshielded-0"]
