"""What does not need Ray of running on Ray."""

import pickle
import socket
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from agents.settings import PPOSettings
from experiments.backends import ray_cluster as cluster
from experiments.backends.execution import results_of
from experiments.backends.ray_cluster import Need, Room, collect, require_answer, stream, work
from experiments.errors import ClusterError, RunError
from experiments.runs.provenance import versions
from experiments.runs.training_run import Unit, run_unit
from experiments.settings.backend import EngineSettings


@pytest.fixture(scope="module")
def unit(certificate):
    return Unit(
        arm="unshielded",
        learner="zero",
        env="ncs_gym/TruckTrailerCruise-v0",
        seed=0,
        index=0,
        steps=64,
        episodes=1,
        certificate=certificate,
        mode=None,
        algorithm="PPO",
        settings=PPOSettings(),
    )


class Fake:
    """A cluster that works on two units at a time, later ones first."""

    def __init__(self, fail=()):
        self.pending, self.most, self.cancelled, self.fail, self.taken = [], 0, [], set(fail), 0

    def units(self, count):
        for number in range(count):
            self.taken += 1
            yield SimpleNamespace(name=str(number))

    def submit(self, unit):
        self.pending.append(unit.name)
        self.most = max(self.most, len(self.pending))
        return unit.name

    def wait(self, references):
        assert references == self.pending
        done = self.pending[-2:]
        del self.pending[-2:]
        return done

    def result(self, unit, reference):
        assert unit.name == reference
        if int(reference) in self.fail:
            raise RunError(f"run {reference}")
        return int(reference)


def run(fake, count, room):
    kept = []
    batches = stream(fake.units(count), fake.submit, fake.wait, fake.cancelled.extend, lambda: room)
    try:
        collect(batches, fake.result, lambda unit, result: kept.append(result))
    finally:
        batches.close()
    return kept


@pytest.mark.parametrize(("count", "room"), [(0, 4), (1, 4), (7, 1), (25, 4), (25, 100)])
def test_every_unit_is_collected_once_and_no_more_are_under_way_than_there_is_room(count, room):
    fake = Fake()
    assert sorted(run(fake, count, room)) == list(range(count))
    assert fake.most == min(count, room)
    assert fake.cancelled == []


def test_units_are_read_only_as_far_as_there_is_room():
    fake = Fake()
    batches = stream(fake.units(10**6), fake.submit, fake.wait, fake.cancelled.extend, lambda: 5)
    next(batches)
    assert fake.taken == 5
    next(batches)
    assert fake.taken == 7
    batches.close()


def test_failure_keeps_what_was_finished_beside_it_and_cancels_the_rest():
    fake, kept = Fake(fail=[4]), []
    batches = stream(fake.units(9), fake.submit, fake.wait, fake.cancelled.extend, lambda: 6)
    with pytest.raises(RunError, match="run 4"):
        collect(batches, fake.result, lambda unit, result: kept.append(result))
    batches.close()
    assert kept == [5]  # the fake finishes 4 and 5 in one batch
    assert fake.cancelled == ["0", "1", "2", "3"]


def test_other_versions_keep_what_was_finished_beside_them():
    fake, kept = Fake(), []

    def result(unit, reference):
        if reference == "4":
            raise ClusterError("node")
        return int(reference)

    batches = stream(fake.units(9), fake.submit, fake.wait, fake.cancelled.extend, lambda: 6)
    with pytest.raises(ClusterError, match="node"):
        collect(batches, result, lambda unit, result: kept.append(result))
    assert kept == [5]


def test_interruption_cancels_what_is_under_way():
    fake = Fake()

    def interrupted(unit, result):
        raise KeyboardInterrupt

    batches = stream(fake.units(9), fake.submit, fake.wait, fake.cancelled.extend, lambda: 4)
    with pytest.raises(KeyboardInterrupt):
        collect(batches, fake.result, interrupted)
    batches.close()
    assert fake.cancelled == ["0", "1"]


def test_waiting_for_nothing_goes_on_waiting():
    fake, silent = Fake(), [3]

    def wait(references):
        silent[0] -= 1
        return [] if silent[0] >= 0 else fake.wait(references)

    batches = stream(fake.units(2), fake.submit, wait, fake.cancelled.extend, lambda: 4)
    assert [len(batch) for batch in batches] == [0, 0, 0, 2]


def test_room_follows_the_cluster_but_does_not_ask_it_all_the_time():
    now, places, asked = [0.0], [100], []

    def look():
        asked.append(now[0])
        return places[0]

    room = Room(look, clock=lambda: now[0])
    assert [room(), room()] == [200, 200]
    places[0] = 1000
    assert (room(), asked) == (200, [0.0])
    now[0] = cluster.LOOK_UP
    assert (room(), asked) == (2000, [0.0, cluster.LOOK_UP])
    places[0], now[0] = 0, 2 * cluster.LOOK_UP
    assert room() == cluster.FEWEST  # a cluster that grows has to see that something waits


@pytest.mark.parametrize(
    ("cpus", "gpus", "node", "places"),
    [
        (1.0, 0.0, {"CPU": 8.0}, 8),
        (3.0, 0.0, {"CPU": 8.0}, 2),
        (0.1, 0.0, {"CPU": 1.0}, 10),
        (0.3, 0.0, {"CPU": 0.9}, 3),
        (9.0, 0.0, {"CPU": 8.0, "GPU": 8.0}, 0),
        (1.0, 1.0, {"CPU": 8.0, "GPU": 2.0}, 2),
        (1.0, 0.25, {"CPU": 8.0, "GPU": 1.0}, 4),
        (1.0, 1.0, {"CPU": 8.0}, 0),
        (1.0, 0.0, {}, 0),
    ],
)
def test_places_of_a_node(cpus, gpus, node, places):
    assert Need(cpus, gpus).places(node) == places


def test_cluster_that_is_too_small_says_what_it_has():
    nodes = [{"CPU": 4.0}, {"CPU": 2.0, "GPU": 1.0}]
    message = str(Need(8.0, 2.0).too_small(nodes))
    assert "8 cores and 2 gpus" in message
    assert "4 cores, 1 gpus" in message
    assert "0 cores" in str(Need(1.0, 0.0).too_small([]))


def test_worker_returns_what_the_unit_returns_here(unit):
    result, expected = work(versions(), pickle.dumps(unit)), run_unit(unit, lambda steps: None)
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
def test_worker_with_other_versions_refuses_before_it_reads_the_unit(change, words):
    with pytest.raises(ClusterError, match=words):
        work(versions() | change, b"no unit")


def test_worker_with_a_package_that_the_driver_lacks_refuses():
    expected = versions()
    del expected["torch"]
    with pytest.raises(ClusterError, match="where the driver has none"):
        work(expected, b"no unit")


def test_node_without_this_package_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "experiments.backends.ray_cluster", None)
    monkeypatch.delattr("experiments.backends.ray_cluster")
    with pytest.raises(ImportError, match=r"node .* cannot import ncs-gym .*: install the same on every node"):
        cluster.carried_work()({}, b"")


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


def test_unit_that_fails_locally_is_named_and_the_finished_are_kept(unit, tmp_path):
    # Whichever comes first, the good one is run by then or ends before the pool does.
    bad = replace(unit, learner="agent", index=1, algorithm="SAC")  # with settings of PPO
    with pytest.raises(RunError, match=r"run unshielded-1: SAC takes OffPolicySettings, got PPOSettings") as error:
        results_of([unit, bad], tmp_path, EngineSettings(jobs=1))
    assert isinstance(error.value.__cause__, ValueError)
    assert [path.stem for path in (tmp_path / "units").glob("*.json")] == ["unshielded-0"]
