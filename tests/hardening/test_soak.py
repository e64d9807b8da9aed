"""Long runs in one process: memory does not grow, and what the estimators hold is what a fresh one computes."""

from pathlib import Path

import numpy as np
import pytest

from ncs_gym import Channel, Estimator, NCSEnv, NCSVectorEnv, Packet
from ncs_gym.estimation import arrival_histories
from ncs_gym.estimation.arrival_histories import ArrivalHistories
from ncs_gym.estimation.estimator import Estimate

EPISODE = 300
# Environments of the vector whose last episodes are computed again.
WATCHED = range(0, 16, 3)
CHANNEL = Channel(0.3, 0.05, 2, 1, 1)
# What a process may gain after it has warmed up [MB].
MOST_GROWTH = 6.0


def resident():
    """Resident memory of this process [MB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024.0


class Diary:
    """What the estimators of some environments of a vector were told since their episodes began."""

    def __init__(self, env, info):
        self.env = env
        self.told = {e: [] for e in WATCHED}
        self.first = {e: info["estimate"][e].copy() for e in WATCHED}
        self.episodes = env.episodes.copy()
        self.in_flight = {e: {} for e in WATCHED}

    def write(self, info):
        """Reads the channel of each watched environment after a step."""
        env = self.env
        delays, samples = env._channel_state._delays[0], env._estimator._samples[0]
        for e in WATCHED:
            if env.episodes[e] != self.episodes[e]:
                self.told[e], self.first[e], self.in_flight[e] = [], info["estimate"][e].copy(), {}
                continue
            step, delay = int(env.steps[e]), int(delays[e])
            if step % env.channel.send_period == 0 and delay >= 0:
                sample = Packet(step, samples[:, e].copy())
                self.in_flight[e].setdefault(step + delay, []).append(sample)
            self.told[e].append((info["input"][e].copy(), self.in_flight[e].pop(step, [])))
        self.episodes = env.episodes.copy()

    def compare(self, info):
        """Computes the present episodes again; returns how many packets came in them."""
        estimator, packets = self.env._estimator, 0
        for e in WATCHED:
            fresh = Estimator(self.env.plant, self.env.channel, self.env.error_set)
            fresh.reset(self.first[e])
            for u, arrived in self.told[e]:
                fresh.advance(u, sorted(arrived, key=lambda packet: packet.stamp))
                packets += len(arrived)
            statistics = estimator.histories.table.statistics(estimator.statistics[e])
            np.testing.assert_array_equal(info["error_shape"][e], fresh.estimate.shape)
            np.testing.assert_array_equal(statistics.covariance, fresh.estimate.covariance)
            np.testing.assert_allclose(info["estimate"][e], fresh.estimate.mean, rtol=0.0, atol=1e-12)
            assert info["measurement_age"][e] == fresh.age
            assert info["assumption_violated"][e] == fresh.alarm
        return packets


def soak_many(plant, count, steps, warm_up):
    """Runs a vector; returns how much memory it gained after the warm-up."""
    env = NCSVectorEnv(count, plant=plant, channel=CHANNEL, max_episode_steps=EPISODE)
    _, info = env.reset(seed=0)
    rng, before = np.random.default_rng(0), 0.0
    actions = rng.uniform(-1.0, 1.0, (64, count, plant.m)).astype(np.float32)
    diary = None
    for k in range(steps):
        *_, info = env.step(actions[k % 64])
        if k == warm_up:
            before = resident()
        if k == steps - 2 * EPISODE:
            diary = Diary(env, info)
        elif diary is not None:
            diary.write(info)
    gained = resident() - before
    # Every watched episode began after the diary did: nothing in it comes from further back.
    assert all(0 < len(diary.told[e]) == env.steps[e] for e in WATCHED)
    assert diary.compare(info) > 10 * len(WATCHED)
    return gained


def soak_one(plant, steps, warm_up):
    """Runs a scalar environment; compares with a fresh estimator some hundred steps back; returns the memory gained."""
    env = NCSEnv(plant, CHANNEL)
    env.reset(seed=0)
    told, before, advance = [], 0.0, env.estimator.advance
    rng = np.random.default_rng(0)
    fresh = None
    for k in range(steps):
        if k == warm_up:
            before = resident()
        if k == steps - 400:
            fresh = restored(env)

            def listening(u, packets):
                told.append((u.copy(), list(packets)))
                advance(u, told[-1][1])

            env.estimator.advance = listening
        env.step(rng.uniform(-1.0, 1.0, plant.m).astype(np.float32))
    gained = resident() - before
    for u, packets in told:
        fresh.advance(u, packets)
    assert sum(len(packets) for _, packets in told) > 50
    for name in Estimate._fields:
        np.testing.assert_array_equal(
            getattr(fresh.estimate, name), getattr(env.estimator.estimate, name), err_msg=name
        )
    assert len(env.estimator._priors) <= CHANNEL.longest_delay + 1
    return gained


def restored(env):
    """A fresh estimator, with a graph of its own, in the state of an environment's."""
    old, new = env.estimator, Estimator(env.plant, env.channel, env.error_set)
    new.step, new.age, new.alarm, new.mean = old.step, old.age, old.alarm, old.mean
    new._history = new._histories.taking_over(old._histories, np.array([old._history])).item()
    new._priors, new._inputs, new._samples = old._priors.copy(), old._inputs.copy(), old._samples.copy()
    return new


def test_a_long_run_neither_grows_nor_drifts(loaded):
    assert soak_many(loaded, 64, 1600, 900) < MOST_GROWTH
    assert soak_one(loaded, 3000, 1000) < MOST_GROWTH


@pytest.mark.parametrize("kind", ["many", "one"])
def test_a_graph_that_forgets_histories_does_not_drift(loaded, monkeypatch, kind):
    monkeypatch.setattr(arrival_histories, "_shared", {})
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", 300 if kind == "many" else 60)
    graphs, keeping = [], ArrivalHistories.keeping

    def counted(graph, histories):
        graphs.append(graph)
        return keeping(graph, histories)

    monkeypatch.setattr(ArrivalHistories, "keeping", counted)
    if kind == "many":
        soak_many(loaded, 16, 1000, 900)
    else:
        soak_one(loaded, 3000, 1000)
    assert len(graphs) > 1
    assert max(map(len, graphs)) < 600


@pytest.mark.slow
def test_ten_million_steps_neither_grow_nor_drift(loaded):
    assert soak_many(loaded, 1024, 9800, 2000) < MOST_GROWTH
    assert soak_one(loaded, 100_000, 10_000) < MOST_GROWTH


@pytest.mark.slow
def test_a_million_steps_of_one_environment_neither_grow_nor_drift(loaded):
    assert soak_one(loaded, 1_000_000, 20_000) < MOST_GROWTH


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 256])
def test_a_million_steps_with_forgetting_do_not_grow(size, loaded, monkeypatch):
    monkeypatch.setattr(arrival_histories, "_shared", {})
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", 4000)
    # Where many samples are late, histories hardly recur: the graph is full again and again.
    settings = {"plant": loaded, "channel": Channel(0.5, jitter=4)}
    env = NCSEnv(**settings) if size == 1 else NCSVectorEnv(size, max_episode_steps=EPISODE, **settings)
    env.reset(seed=0)
    rng, forgotten, sizes = np.random.default_rng(0), set(), []
    actions = 0.01 * rng.uniform(-1.0, 1.0, (64, *env.action_space.shape)).astype(np.float32)
    for k in range(1_000_000 // size):
        env.step(actions[k % 64])
        if size == 1 and k % EPISODE == 0:
            env.reset()
        if k % (50_000 // size) == 0:
            sizes.append(resident())
            forgotten.add(id(env.estimator._histories if size == 1 else env._estimator.histories))
    assert len(forgotten) > 3
    assert max(sizes[8:]) - max(sizes[4:8]) < MOST_GROWTH
