from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import NCSVectorEnv
from shields import Decision, SafetyShield
from shields.runtime.vector_wrapper import overridden
from tests import arrays
from tests.certificates import certificate_of
from tests.product import vector_env, vector_shield
from tests.shields.attacks.cases import CHANNELS, TRUCKS, harmful


def test_error_shapes_that_the_environment_forgets_and_meets_again_change_nothing():
    class Forgetful(NCSVectorEnv):
        @property
        def error_shapes(self):
            table, numbers = super().error_shapes
            present, again = np.unique(numbers, return_inverse=True)
            return SimpleNamespace(shapes=table.shapes[present]), again

    runs = []
    for kind in (vector_env, Forgetful):
        env = kind(6, plant=TRUCKS["4000 kg"], channel=CHANNELS["overtaking"], max_episode_steps=30)
        shield, rng = vector_shield(env, certificate_of(env.plant)), np.random.default_rng(0)
        infos = [shield.reset(seed=0)[1]]
        infos += [shield.step(rng.uniform(-1, 1, (6, 1)))[4] for _ in range(60)]
        runs.append(infos)
    for one, other in zip(*runs, strict=True):
        for key, value in one.items():
            arrays.assert_equal(value, other[key])


@pytest.mark.parametrize(
    ("given", "kept"), [(np.float32, np.float32), (np.float64, np.float64), (np.int64, np.float64)]
)
def test_overridden_actions_are_numbers_of_the_callers_kind(given, kept):
    decided = Decision(np.array([[1.0, 3.0]]), np.array([True, False]), *np.zeros((4, 2)))
    actions = overridden(np.array([[1], [1]], given), decided, TRUCKS["4000 kg"])
    assert actions.dtype == kept
    np.testing.assert_array_equal(actions, [[0.25], [1.0]])


def outwards(shield, info):
    return np.sign(info["estimate"] @ (shield.certificate.M @ shield.unwrapped.plant.B))


def test_last_steps_behind_the_shields_back_promise_nothing():
    plant = TRUCKS["4000 kg"]
    env = vector_env(50, plant=plant, disturbance=harmful(plant), max_episode_steps=30, autoreset_mode="SameStep")
    shield = vector_shield(env, certificate_of(plant))
    _, info = shield.reset(seed=0)
    for _ in range(28):
        _, _, _, _, info = shield.step(outwards(shield, info))
    env.step(outwards(shield, info))
    _, _, _, truncated, info = shield.step(outwards(shield, info))
    assert truncated.all()
    assert not info["final_info"]["shield_guaranteed"].any()
    _, _, _, _, info = shield.step(outwards(shield, info))
    assert not info["shield_guaranteed"].any()


def test_scalar_shields_in_gymnasiums_sync_environment_still_work():
    env = gym.make_vec("ncs_gym/TruckTrailerCruise-v0", num_envs=2, vectorization_mode="sync", wrappers=[SafetyShield])
    env.reset(seed=0)
    assert env.step(np.ones((2, 1), np.float32))[4]["shield_guaranteed"].all()
