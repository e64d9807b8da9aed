"""Arrival histories recur, in every registered environment: a vector of them costs what its steps cost."""

import gymnasium as gym
import numpy as np
import pytest

import ncs_gym  # noqa: F401

# Gymnasium's pendulum, sampled every second step on a channel without a contract: 14,000 histories, and slow because of
# them (docs/vector.md). InvertedPendulum-v0 needs MuJoCo.
EXCEPTED = {"ncs_gym/Pendulum-v0", "ncs_gym/InvertedPendulum-v0", "ncs_gym/LinearNCS-v0"}
IDS = sorted(each for each in gym.registry if each.startswith("ncs_gym/") and each not in EXCEPTED)
# Convoy-v0 has 4,000 and ConvoyOnRequest-v0 5,000; shapes that do not recur make more than 11,000.
MOST = 6_000


@pytest.mark.cases(2)
@pytest.mark.parametrize("env_id", IDS)
def test_histories_of_a_vector_recur(env_id):
    envs = gym.make_vec(env_id, 1024)
    envs.reset(seed=0)
    idle = np.zeros(envs.action_space.shape, np.float32)
    for _ in range(30):
        envs.step(idle)
    assert len(envs.unwrapped._now.estimator.histories) < MOST
