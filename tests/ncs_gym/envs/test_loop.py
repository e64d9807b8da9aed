"""What a controller can know of a loop, and what is true besides: decisions rest on the first alone."""

import numpy as np
import pytest

from ncs_gym.envs.loop import ManyLoops, OneLoop
from tests.product import gym_env, gym_vector_env, safety_shield, vector_shield

TRUTH = ("state", "estimation_error", "constraint_values")


def without_truth(report):
    """A method that reports the same, but for what is true of the loop."""

    def unknowing(self, *arguments, **named):
        belief, info = report(self, *arguments, **named)
        return belief, info | {name: np.full_like(info[name], np.nan) for name in TRUTH}

    return unknowing


def decisions(env):
    rng, found = np.random.default_rng(0), []
    env.reset(seed=4)
    for _ in range(50):
        *_, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
        found.append([np.copy(info[key]) for key in ("action_committed", "shield_intervened", "shield_guaranteed")])
    return found


CASES = [(False, "CartPoleTwoWay", "lookahead"), (True, "Convoy", "lookahead"), (True, "CartPoleTwoWay", "project")]


@pytest.mark.parametrize(("many", "name", "mode"), CASES)
def test_decisions_are_the_same_where_the_truth_is_not_told(monkeypatch, many, name, mode):
    def shielded():
        env_id, settings = f"ncs_gym/{name}-v0", {"terminate_on_violation": False}
        env = gym_vector_env(3, env_id=env_id, **settings) if many else gym_env(env_id=env_id, **settings)
        return (vector_shield if many else safety_shield)(env, mode=mode)

    told = decisions(shielded())
    for kind in (OneLoop, ManyLoops):
        monkeypatch.setattr(kind, "report", without_truth(kind.report))
    for one, other in zip(told, decisions(shielded()), strict=True):
        for value, same in zip(one, other, strict=True):
            np.testing.assert_array_equal(value, same)
    assert any(np.any(intervened) for _, intervened, _ in told)
