"""Long runs in one process: memory does not grow."""

from pathlib import Path

import numpy as np
import pytest

from ncs_gym import Channel, NCSEnv
from ncs_gym.estimation import arrival_histories
from ncs_gym.estimation.arrival_histories import ArrivalHistories
from tests.product import loop_env, vector_env

EPISODE = 300
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
    assert growth(many(loaded, 32), 650, 400) < MOST_GROWTH
    assert growth(loop_env(loaded, CHANNEL), 1200, 600) < MOST_GROWTH


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 256])
def test_a_million_steps_with_forgetting_do_not_grow(size, loaded, forgotten, monkeypatch):
    monkeypatch.setattr(arrival_histories, "MAX_HISTORIES", 4000)
    # Where many samples are late, histories hardly recur: the graph is full again and again.
    settings = {"plant": loaded, "channel": Channel(0.5, jitter=4)}
    env = loop_env(**settings) if size == 1 else vector_env(size, max_episode_steps=EPISODE, **settings)
    assert growth(env, 1_000_000 // size, 400_000 // size) < MOST_GROWTH
    assert len(forgotten) > 3
