"""Long runs in one process: memory does not grow, and what the estimators hold is what a fresh one computes."""

from pathlib import Path

import numpy as np
import pytest

from ncs_gym import Channel, NCSEnv, Packet
from ncs_gym.estimation import arrival_histories
from ncs_gym.estimation.arrival_histories import ArrivalHistories, histories_of
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.vector_estimator import VectorEstimator
from tests.product import loop_env, vector_env
from tests.shields.attacks.adversary import Traffic

EPISODE = 300
# Columns of a vector whose last episodes are computed again; the first one is also that of a single estimator.
WATCHED = range(0, 16, 3)
CHANNEL = Channel(0.3, quantization_step=0.05, send_period=2, delay=1, jitter=1)
# What a process may gain after it has warmed up [MB].
MOST_GROWTH = 6.0


def resident():
    """Resident memory of this process [MB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024.0


def growth(env, steps, warm_up):
    """How much memory a run of an environment, or of many, takes after the warm-up [MB]."""
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (64, *env.action_space.shape)).astype(np.float32)
    before = 0.0
    for k in range(steps):
        env.step(actions[k % 64])
        if isinstance(env, NCSEnv) and k % EPISODE == EPISODE - 1:
            env.reset()
        if k == warm_up:
            before = resident()
    return resident() - before


def many(plant, count):
    return vector_env(count, plant=plant, channel=CHANNEL, max_episode_steps=EPISODE)


def run_estimators(plant, count, episodes):
    """Runs many estimators and a single one with the same samples; compares their last episodes with fresh ones."""
    rng, error_set = np.random.default_rng(0), certified_error_set(plant, None)
    vector = VectorEstimator(plant, histories_of(plant, CHANNEL, error_set), count)
    single = Estimator(plant, CHANNEL, histories=histories_of(plant, CHANNEL, error_set))
    for _ in range(episodes):
        first = 1e-2 * rng.standard_normal((plant.n, count))
        vector.begin(np.ones(count, np.bool_), first)
        single.reset(first[:, 0])
        traffic, samples = Traffic(CHANNEL.longest_delay, None, count), []
        told = {e: [] for e in WATCHED}
        for step in range(1, EPISODE + 1):
            u = 0.1 * rng.uniform(-1.0, 1.0, (plant.m, count))
            samples = [1e-2 * rng.standard_normal((plant.p, count)), *samples[: traffic.oldest]]
            arrivals = traffic.arrivals(rng, step)
            vector.advance(u, samples[0], arrivals)
            for e in WATCHED:
                packets = [Packet(step - age, samples[age][:, e]) for age, comes in arrivals if comes[e]]
                told[e].append((u[:, e], packets))
            single.advance(u[:, 0], [packet._replace(episode=single.episode) for packet in told[0][-1][1]])
    shapes, packets = vector.histories.table.shapes.take(vector.statistics, axis=0), 0
    for e in WATCHED:
        fresh = Estimator(plant, CHANNEL, error_set)
        fresh.reset(first[:, e])
        for u, arrived in told[e]:
            fresh.advance(u, arrived)
            packets += len(arrived)
        np.testing.assert_array_equal(shapes[e], fresh.shape)
        np.testing.assert_allclose(vector.mean[:, e], fresh.mean, rtol=0.0, atol=1e-12)
        assert (vector.age[e], vector.alarm[e]) == (fresh.age, fresh.alarm)
        for name in ("mean", "covariance", "shape", "age") if e == 0 else ():
            np.testing.assert_array_equal(getattr(single, name), getattr(fresh, name), err_msg=name)
    assert packets > 10 * len(WATCHED)


@pytest.fixture
def forgotten(monkeypatch):
    """Graphs of histories that were forgotten but for those in use; they are forgotten when there are few."""
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", 300)
    graphs, keeping = [], ArrivalHistories.keeping

    def counted(graph, histories):
        graphs.append(len(graph))
        return keeping(graph, histories)

    monkeypatch.setattr(ArrivalHistories, "keeping", counted)
    return graphs


def test_a_long_run_does_not_grow(loaded):
    assert growth(many(loaded, 64), 800, 500) < MOST_GROWTH
    assert growth(loop_env(loaded, CHANNEL), 1500, 700) < MOST_GROWTH


@pytest.mark.slow
def test_estimators_whose_graph_forgets_histories_do_not_drift(loaded, forgotten):
    run_estimators(loaded, 16, 2)
    assert len(forgotten) > 1
    assert max(forgotten) < 600


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 256])
def test_a_million_steps_with_forgetting_do_not_grow(size, loaded, forgotten, monkeypatch):
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", 4000)
    # Where many samples are late, histories hardly recur: the graph is full again and again.
    settings = {"plant": loaded, "channel": Channel(0.5, jitter=4)}
    env = loop_env(**settings) if size == 1 else vector_env(size, max_episode_steps=EPISODE, **settings)
    assert growth(env, 1_000_000 // size, 400_000 // size) < MOST_GROWTH
    assert len(forgotten) > 3
