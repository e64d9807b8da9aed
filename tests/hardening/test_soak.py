"""Long runs in one process: memory does not grow."""

from pathlib import Path

import numpy as np

from ncs_gym import Channel, NCSEnv
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


def test_a_long_run_does_not_grow(loaded):
    assert growth(vector_env(32, plant=loaded, channel=CHANNEL, max_episode_steps=EPISODE), 650, 400) < MOST_GROWTH
    assert growth(loop_env(loaded, CHANNEL), 1200, 600) < MOST_GROWTH
