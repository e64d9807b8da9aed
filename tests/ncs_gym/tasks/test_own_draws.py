"""What a task draws changes nothing in the loop."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Regulation


class Restless(Regulation):
    """Draws more than the task that it is made of."""

    def begin(self, rng, plant, size=None):
        rng.random(7)
        return super().begin(rng, plant, size)

    def advance(self, rng, plant, task_state, u):
        rng.random(3)
        return super().advance(rng, plant, task_state, u)


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_loop_is_the_same_whatever_a_task_draws(make):
    seen = []
    for task in (None, Restless()):
        env = make("ncs_gym/TruckTrailerCruise-v0", task=task)
        infos = [env.reset(seed=5)[1]] + [env.step(np.zeros(env.action_space.shape))[4] for _ in range(30)]
        infos.append(env.reset()[1])
        seen.append(
            [np.concatenate([np.ravel(info[key]) for key in ("state", "estimate", "packets")]) for info in infos]
        )
    np.testing.assert_array_equal(*seen)
